"""A whole turn in one message does what its two halves do, and a refused one does nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.costs import Costs
from bot_runtime.fallback import Reason
from protocol.errors import (
    BadSchema,
    BadShape,
    FrameReused,
    NoBot,
    NonFinite,
    OutOfRange,
    OverBudget,
    ProtocolError,
    StaleFrame,
)
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine, Poisoned

N = 3
SEEDS = [5, 6, 7]


def take(engine: Engine, handles: np.ndarray, frame: int, query: np.ndarray, **options: Any) -> Any:
    n = handles.size
    given = {"rewards_N": engine.rewards(frame, n), **options}
    return engine.bots.take_turn(handles, frame, engine.free(frame, n), query, engine.costly(frame, n), **given)


@pytest.mark.parametrize("kind", ["bundle", "memoryless", "conditioned"])
@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_it_is_its_two_halves(kind: str, order: list[int], request: pytest.FixtureRequest) -> None:
    """Over whole episodes, with failures, skipped frames and both kinds of turn mixed: to the bit."""
    bundle = request.getfixturevalue(kind)
    halves, wholes = Engine(Bots(bundle, max_bots=8)), Engine(Bots(bundle, max_bots=8))
    first, second = (each.bots.start(N, seeds=SEEDS)[order] for each in (halves, wholes))
    random = np.random.default_rng(1)
    for frame in range(0, 60, 2):
        queries = halves.ask(first, frame, frame_budget_us=20.0)
        query = queries.query_NM
        failed = query & (random.random(query.shape) < 0.2)
        costly = halves.costly(frame, N)
        expected = halves.bots.submit_features(first, frame, query & ~failed, costly, failed)
        if frame % 3:
            got = take(wholes, second, frame, query & ~failed, failed_NM=failed, frame_budget_us=20.0)
        else:
            assert np.array_equal(wholes.ask(second, frame, frame_budget_us=20.0).query_NM, query)
            got = wholes.bots.submit_features(second, frame, query & ~failed, costly, failed)
        assert got.action_NA.tobytes() == expected.action_NA.tobytes()
        assert np.array_equal(got.reasons_N, expected.reasons_N)
        assert got.turns_N.tolist() == expected.turns_N.tolist() == [frame // 2 + 1] * N
        assert np.array_equal(wholes.bots.hidden(second), halves.bots.hidden(first))
    assert wholes.bots.counters.reasons == halves.bots.counters.reasons
    assert wholes.bots.counters.skipped_frames == halves.bots.counters.skipped_frames
    assert wholes.bots.spent.asked_us == halves.bots.spent.asked_us


def test_a_retry_gets_the_same_answer_and_other_content_does_not(engine: Engine) -> None:
    handles = engine.bots.start(N, seeds=SEEDS)
    engine.play(handles, range(3))
    query = np.zeros((N, engine.table.n_queries), dtype=bool)
    query[:, 0] = True
    actions = take(engine, handles, 5, query)
    assert take(engine, handles, 5, query) is actions
    assert take(engine, handles, 5, query, acquire_us=None) is actions
    for other in (
        {"rewards_N": np.zeros(N)},
        {"acquire_us": 3.0},
        {"frame_budget_us": 50.0},
        {"failed_NM": query},
        {"failed_NM": ~query & (np.arange(query.shape[1]) == 1)},
        {"rewards_N": None, "replayed_returns_to_go": [1.0] * N},
    ):
        with pytest.raises(FrameReused):
            take(engine, handles, 5, query, **other)
    with pytest.raises(FrameReused):
        take(engine, handles, 5, np.zeros_like(query))
    with pytest.raises(FrameReused):
        take(engine, handles[::-1].copy(), 5, query)
    with pytest.raises(FrameReused):
        engine.ask(handles, 5)
    with pytest.raises(FrameReused):
        engine.bots.submit_features(handles, 5, query, engine.costly(5, N))
    assert take(engine, handles, 5, query) is actions
    queries = engine.ask(handles, 6)
    with pytest.raises(FrameReused):
        take(engine, handles, 6, queries.query_NM)
    assert engine.submit(handles, 6, queries).turns_N.tolist() == [5] * N


def test_a_refused_turn_changes_nothing(bundle: Bundle) -> None:
    def play(*, with_refusals: bool) -> list[bytes]:
        engine = Engine(Bots(bundle, max_bots=8))
        handles, played = engine.bots.start(N, seeds=SEEDS, budgets_us=[9.0] * N), []
        for frame in range(1, 12):
            free, costly = engine.free(frame, N), engine.costly(frame, N)
            nothing = np.zeros((N, engine.table.n_queries), dtype=bool)
            everything = ~nothing
            turn = engine.bots.take_turn
            for refusal, refused in _refusals(turn, handles, frame, free, costly, nothing, everything):
                if with_refusals:
                    with pytest.raises(refusal):
                        refused()
            query = nothing.copy()
            query[:, frame % 3] = True
            actions = turn(handles, frame, free, query, costly)
            assert turn(handles, frame, free, query, costly) is actions
            if with_refusals:
                with pytest.raises(NonFinite):  # the next frame's refusal, and this one's retry after it
                    turn(handles, frame + 1, free, query, np.full_like(costly, np.nan))
                assert turn(handles, frame, free, query, costly) is actions
            played.append(actions.action_NA.tobytes())
        return played

    assert play(with_refusals=True) == play(with_refusals=False)


def _refusals(
    turn: Callable[..., Any],
    handles: np.ndarray,
    frame: int,
    free: np.ndarray,
    costly: np.ndarray,
    nothing: np.ndarray,
    everything: np.ndarray,
) -> list[tuple[type[ProtocolError], Callable[[], Any]]]:
    return [
        (OverBudget, lambda: turn(handles, frame, free, everything, costly)),
        (OverBudget, lambda: turn(handles, frame, free, nothing, costly, failed_NM=everything)),
        (OverBudget, lambda: turn(handles, frame, free, nothing | [True, *[False] * 4], costly, frame_budget_us=3.7)),
        (OverBudget, lambda: turn(handles, frame, free, nothing | [True, *[False] * 4], costly, budgets_us=[9, 9, 1])),
        (NonFinite, lambda: turn(handles, frame, np.full_like(free, np.nan), nothing, costly)),
        (NonFinite, lambda: turn(handles, frame, free, nothing, costly, rewards_N=[0.0, np.nan, 0.0])),
        (NonFinite, lambda: turn(handles, frame, free, nothing, costly, replayed_returns_to_go=[0.0, np.inf, 0.0])),
        (OutOfRange, lambda: turn(handles, frame, free, nothing, costly, replayed_returns_to_go=[0.0, 2e30, 0.0])),
        (OutOfRange, lambda: turn(handles, frame, free, nothing, costly, acquire_us=-1.0)),
        (BadShape, lambda: turn(handles, frame, free, nothing[:, 1:], costly)),
        (BadShape, lambda: turn(handles, frame, free, nothing, costly, failed_NM=nothing[0])),
        (BadShape, lambda: turn(handles, frame, free, nothing, costly, replayed_returns_to_go=[0.0])),
        (
            BadSchema,
            lambda: turn(handles, frame, free, nothing, costly, None, [0.0] * N, replayed_returns_to_go=[0.0] * N),
        ),
        (StaleFrame, lambda: turn(handles, frame - 2, free, nothing, costly)) if frame > 2 else
        (NoBot, lambda: turn(handles + 2**32, frame, free, nothing, costly)),
    ]  # fmt: skip


def test_budgets_hold_by_measured_costs_too(bundle: Bundle) -> None:
    """The cost model that counts is the one that the engine measures, and a whole turn teaches it as its halves do."""
    engine = Engine(Bots(bundle, max_bots=8))
    model = CostModel.declared(engine.table)
    halves, wholes = Costs(model), Costs(model)
    handles, others = engine.bots.start(N, seeds=SEEDS), engine.bots.start(N, seeds=SEEDS)
    for frame in range(30):
        queries = engine.ask(handles, frame, costs=halves)
        measured_us = 3.0 * float(queries.cost_us_N.sum()) / max(halves.full_us / model.full_us, 1.0) + 1.0
        query, costly = queries.query_NM, engine.costly(frame, N)
        expected = engine.bots.submit_features(handles, frame, query, costly, None, measured_us, halves)
        got = take(engine, others, frame, query, acquire_us=measured_us, costs=wholes)
        assert got.action_NA.tobytes() == expected.action_NA.tobytes()
        assert wholes.report() == halves.report()
    assert wholes.full_us > 1.5 * model.full_us
    dear = np.zeros((N, engine.table.n_queries), dtype=bool)
    dear[0, 3] = True
    budget_us = model.costs_us[3] * 1.2
    with pytest.raises(OverBudget):
        take(engine, others, 30, dear, costs=wholes, budgets_us=[budget_us] * N)
    assert take(engine, others, 30, dear, budgets_us=[budget_us] * N).turns_N[0] == 31


def test_a_bot_whose_network_says_nothing_finite_falls_back_as_in_two_messages(
    engine: Engine, poisoned: Poisoned
) -> None:
    handles, others = engine.bots.start(N, seeds=SEEDS), engine.bots.start(N, seeds=SEEDS)
    poisoned.probs, poisoned.step = {0: float("nan")}, {1: ("hidden_NW", float("inf"))}
    for frame in range(4):
        queries = engine.ask(handles, frame)
        expected, got = engine.submit(handles, frame, queries), take(engine, others, frame, queries.query_NM)
        assert got.action_NA.tobytes() == expected.action_NA.tobytes()
        assert got.reasons_N.tolist() == expected.reasons_N.tolist()
        assert got.turns_N.tolist() == expected.turns_N.tolist() == [frame + 1, 0, frame + 1]
    poisoned.step = {}
    query = np.zeros((N, engine.table.n_queries), dtype=bool)
    query[0, 0] = True
    assert take(engine, others, 9, query).reasons_N.tolist() == [Reason.LEARNED] * N, "it did acquire something"


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 60.0), st.booleans())
def test_what_the_server_would_ask_is_never_over_budget(
    bundle: Bundle, seed: int, budget_us: float, call: bool
) -> None:
    engine = Engine(Bots(bundle, max_bots=2 * N), seed)
    model = CostModel(3.3 if call else 0.0, CostModel.declared(engine.table).feature_us)
    start = {"seeds": SEEDS, "budgets_us": [budget_us] * N, "cost_model": model}
    handles, others = engine.bots.start(N, **start), engine.bots.start(N, **start)
    shared_us = budget_us * 1.7
    for frame in range(3):
        query = engine.ask(handles, frame, frame_budget_us=shared_us).query_NM
        take(engine, others, frame, query, frame_budget_us=shared_us)
