"""Bots of a bundle without a context: whole turns like any other's, and nothing of the past in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.fallback import Reason
from tests.bot_runtime.conftest import Engine, Poisoned
from tests.bundles import make_bundle


def outcome(bundle: Bundle, past: int, frame: int = 9) -> tuple[bytes, bytes]:
    """Query probabilities and action of one frame after `past` turns of other content, with the same noise counter."""
    engine, other = Engine(Bots(bundle, max_bots=2)), Engine(Bots(bundle, max_bots=2), seed=past)
    other.bots = engine.bots
    handles = engine.bots.start(2, seeds=[4, 5], budgets_us=[1e6] * 2)
    for turn in range(3):
        queries = engine.bots.request_queries(handles, turn, other.free(turn, 2))
        other.submit(handles, turn, queries)
    queries = engine.bots.request_queries(handles, frame, engine.free(frame, 2))
    return queries.probs_NM.tobytes(), engine.submit(handles, frame, queries).action_NA.tobytes()


def test_the_past_changes_nothing(memoryless: Bundle, bundle: Bundle) -> None:
    assert len({outcome(memoryless, past) for past in range(4)}) == 1
    assert len({outcome(bundle, past) for past in range(4)}) == 4


def test_noise_goes_on_and_returns_to_go_are_spent(memoryless: Bundle) -> None:
    """The same frame content twice: other noise, another action; a reward: other probabilities."""
    engine = Engine(Bots(memoryless, max_bots=1))
    handles, free = engine.bots.start(1, target_returns=[5.0]), engine.free(0, 1)
    first = engine.bots.request_queries(handles, 0, free)
    one = engine.bots.submit_features(handles, 0, first.query_NM, engine.costly(0, 1))
    second = engine.bots.request_queries(handles, 1, free)
    assert np.array_equal(second.probs_NM, first.probs_NM)
    two = engine.bots.submit_features(handles, 1, second.query_NM, engine.costly(0, 1))
    assert not np.array_equal(two.action_NA, one.action_NA)
    third = engine.bots.request_queries(handles, 2, free, [4.0])
    assert np.abs(third.probs_NM - first.probs_NM).max() > 1e-3


def test_episode_equals_the_golden_one(tmp_path: Path) -> None:
    path = make_bundle(tmp_path / "tiny", context_length=1, target_cost=0.6, budget=1.0)
    bots = Bots(Bundle.load(path), max_bots=3)
    with np.load(path / "golden.npz") as archive:
        golden = dict(archive)
    handles = bots.start(3, seeds=[1, int(golden["seed"]), 2], target_returns=[10.0] * 3)
    for turn in range(len(golden["free"])):
        free, costly = (np.repeat(golden[name][turn : turn + 1], 3, axis=0) for name in ("free", "costly"))
        queries = bots.request_queries(handles, turn, free, [golden["rewards"][turn]] * 3)
        assert queries.query_NM[1].tolist() == golden["queries"][turn].astype(bool).tolist()
        actions = bots.submit_features(handles, turn, queries.query_NM, costly)
        np.testing.assert_allclose(queries.probs_NM[1], golden["probs"][turn], atol=1e-4)
        np.testing.assert_allclose(actions.action_NA[1], golden["actions"][turn], atol=1e-4)


def test_bots_regroup_stop_and_start(memoryless: Bundle) -> None:
    """Every slot and order, also all rows in order, where the arena hands out itself."""
    engine = Engine(Bots(memoryless, max_bots=4))
    handles = engine.bots.start(4)
    engine.turn(handles, 0)
    engine.turn(handles[[3, 1]], 1)
    engine.bots.stop(handles[1:3])
    engine.turn(np.concatenate([engine.bots.start(2), handles[[3, 0]]]), 2)
    assert engine.bots.counters.reasons[Reason.LEARNED] == 10


def test_a_step_that_is_not_finite_is_still_caught(memoryless: Bundle) -> None:
    engine = Engine(Bots(memoryless, max_bots=2))
    poison = engine.bots._policy = Poisoned(engine.bots._policy)
    handles = engine.bots.start(2)
    last = engine.turn(handles, 0)
    poison.step = {1: ("action_NA", np.nan)}
    actions = engine.turn(handles, 1)
    assert actions.reasons_N.tolist() == [Reason.LEARNED, Reason.NON_FINITE_STEP_LAST_ACTION]
    assert np.array_equal(actions.action_NA[1], last.action_NA[1])
