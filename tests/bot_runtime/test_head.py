"""A head in the engine asks for what the server would have asked for, to the bit, over whole episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.costs import Costs
from bot_runtime.head import Head
from protocol.errors import BadShape, NonFinite, OutOfRange
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine, Poisoned

N = 3
SEEDS = [5, 2**63 - 1, 7]


def limits_of(frame: int) -> dict[str, Any]:
    """Different frames say different things of budgets."""
    return [
        {},
        {"frame_budget_us": 25.0},
        {"budgets_us": [4.0, 0.0, 30.0]},
        {"target_costs_us": [2.0, 9.0, 1.0], "frame_budget_us": 12.5},
    ][frame % 4]


def play(
    bundle: Bundle, *, by_head: set[int], frames: range, measured: bool = False, step: dict[int, Any] | None = None
) -> list[bytes]:
    """Whole turns where `by_head` says so, else two messages; the bytes of every query and action."""
    engine, played = Engine(Bots(bundle, max_bots=8)), []
    poisoned = engine.bots._policy = Poisoned(engine.bots._policy)
    model = CostModel(3.3, CostModel.declared(engine.table).feature_us)
    theirs, own = Costs(model), Costs(model)
    start = {"target_returns": [9.0, 20.0, -3.0], "budgets_us": [20.0, 15.0, 1e6]}
    handles = engine.bots.start(N, seeds=SEEDS, cost_model=model, **start)
    manifest = bundle.manifest
    head = Head(manifest, bundle.acquisition, SEEDS, cost_model=model, costs=own, **start)
    for frame in frames:
        poisoned.step = {} if step is None or frame % 5 else step
        rewards, free, costly, limits = (
            engine.rewards(frame, N),
            engine.free(frame, N),
            engine.costly(frame, N),
            limits_of(frame),
        )
        if frame in by_head:
            queries = head.ask(frame, free, rewards, **limits)
        else:
            head.skip(rewards)
            costs = theirs if theirs.n_frames else None
            queries = engine.bots.request_queries(handles, frame, free, rewards, **limits, costs=costs)
        query_NM = queries.query_NM
        failed = query_NM & (np.random.default_rng(frame).random(query_NM.shape) < 0.2)
        acquired, us = query_NM & ~failed, float(7.0 + 5.0 * query_NM.sum()) if measured else None
        if frame in by_head:
            actions = engine.bots.take_turn(
                handles, frame, free, acquired, costly, failed, rewards, **limits, acquire_us=us, costs=theirs
            )
        else:
            actions = engine.bots.submit_features(handles, frame, acquired, costly, failed, us, theirs)
        if us is not None:
            own.observe(acquired, us)
        head.keep(engine.bots.hidden(handles), actions.turns_N)
        played.append(query_NM.tobytes() + queries.cost_us_N.tobytes() + actions.action_NA.tobytes())
        assert own.report() == theirs.report()
    return played


@pytest.mark.parametrize("kind", ["bundle", "memoryless", "conditioned"])
@pytest.mark.parametrize("measured", [False, True])
def test_every_frame_no_frame_and_some_frames_by_the_head_are_one_episode(
    kind: str, measured: bool, request: pytest.FixtureRequest
) -> None:
    bundle, frames = request.getfixturevalue(kind), range(0, 120, 3)
    by_server = play(bundle, by_head=set(), frames=frames, measured=measured)
    assert play(bundle, by_head=set(frames), frames=frames, measured=measured) == by_server
    mixed = set(np.random.default_rng(0).choice(list(frames), 20, replace=False).tolist())
    assert play(bundle, by_head=mixed, frames=frames, measured=measured) == by_server
    assert len(set(by_server)) == len(by_server)


def test_a_turn_that_the_context_did_not_take_is_none_for_the_head_either(bundle: Bundle) -> None:
    frames, step = range(40), {1: ("action_NA", float("nan"))}
    by_server = play(bundle, by_head=set(), frames=frames, step=step)
    assert play(bundle, by_head=set(frames), frames=frames, step=step) == by_server
    assert by_server != play(bundle, by_head=set(), frames=frames)


def test_defaults_are_those_of_a_start(conditioned: Bundle, bundle: Bundle) -> None:
    for served in (conditioned, bundle):
        engine = Engine(Bots(served, max_bots=8))
        handles, head = engine.bots.start(N), Head(served.manifest, served.acquisition, range(N))
        asked, own = engine.ask(handles, 0), head.ask(0, engine.free(0, N), engine.rewards(0, N))
        assert np.array_equal(own.query_NM, asked.query_NM)
        assert np.array_equal(own.probs_NM, asked.probs_NM)


def test_asking_again_counts_no_reward_twice(bundle: Bundle) -> None:
    engine, head = Engine(Bots(bundle, max_bots=8)), Head(bundle.manifest, bundle.acquisition, SEEDS)
    handles = engine.bots.start(N, seeds=SEEDS)
    first = head.ask(0, engine.free(0, N), engine.rewards(0, N))
    assert np.array_equal(head.ask(0, engine.free(0, N), engine.rewards(0, N)).probs_NM, first.probs_NM)
    assert np.array_equal(engine.ask(handles, 0).probs_NM, first.probs_NM)


def test_what_does_not_fit_is_refused(bundle: Bundle) -> None:
    manifest, head = bundle.manifest, Head(bundle.manifest, bundle.acquisition, SEEDS)
    free = Engine(Bots(bundle, max_bots=8)).free(0, N)
    turns, hidden = np.zeros(N, dtype=np.int64), np.zeros((N, manifest.width), dtype=np.float32)
    for refusal, refused in (
        (BadShape, lambda: head.ask(0, free[1:])),
        (BadShape, lambda: head.ask(0, free, [0.0])),
        (NonFinite, lambda: head.ask(0, np.full_like(free, np.nan))),
        (OutOfRange, lambda: head.ask(0, free, frame_budget_us=-1.0)),
        (BadShape, lambda: head.keep(hidden[1:], turns)),
        (BadShape, lambda: head.keep(hidden, turns[1:])),
        (BadShape, lambda: Head(manifest, bundle.acquisition, SEEDS, budgets_us=[1.0])),
        (OutOfRange, lambda: Head(manifest, bundle.acquisition, [-1])),
    ):
        with pytest.raises(refusal):
            refused()
