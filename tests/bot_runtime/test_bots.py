"""Bots: turns and budgets, what an engine that keeps the rules sees."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol import errors
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine, Poisoned
from tests.bundles import make_bundle

UNLIMITED = 1e6


def test_plays_and_is_repeatable(bundle: Bundle) -> None:
    plays = []
    for _ in range(2):
        engine = Engine(Bots(bundle, max_bots=8))
        plays.append(engine.play(engine.bots.start(3, seeds=[5, 6, 7]), range(20)))
    assert plays[0] == plays[1]
    other = Engine(Bots(bundle, max_bots=8))
    assert other.play(other.bots.start(3, seeds=[5, 6, 8]), range(20)) != plays[0]


def test_episode_equals_the_golden_one(bundle: Bundle, bundle_path: Path) -> None:
    """Through the façade, among other bots, in a slot that was used before."""
    with np.load(bundle_path / "golden.npz") as archive:
        golden = dict(archive)
    bots = Bots(bundle, max_bots=3)
    engine, table = Engine(bots), bundle.manifest.features
    used = bots.start(2)
    engine.play(used, range(6))
    bots.stop(used[:1])
    handle = bots.start(1, seeds=[int(golden["seed"])], target_returns=[10.0], budgets_us=[UNLIMITED])
    both = np.array([used[1], handle[0]])
    for turn in range(len(golden["free"])):
        free = np.stack([engine.free(turn, 1)[0], golden["free"][turn]])
        queries = bots.request_queries(both, 100 + turn, free, [0.0, golden["rewards"][turn]])
        assert queries.query_NM[1].tolist() == golden["queries"][turn].astype(bool).tolist()
        costly = np.stack([np.zeros(table.n_costly, dtype=np.float32), golden["costly"][turn]])
        actions = bots.submit_features(both, 100 + turn, queries.query_NM, costly)
        np.testing.assert_allclose(queries.probs_NM[1], golden["probs"][turn], atol=1e-4)
        np.testing.assert_allclose(actions.action_NA[1], golden["actions"][turn], atol=1e-4)


def test_a_bot_plays_the_same_alone_and_in_company(bundle: Bundle) -> None:
    """Bots that join at different frames, in any order of rows, and with budgets of their own."""
    alone, company = Bots(bundle, max_bots=8), Bots(bundle, max_bots=8)
    one = alone.start(1, seeds=[3], budgets_us=[9.0])
    others = company.start(3, seeds=[1, 2, 4])
    engine_one, engine = Engine(alone), Engine(company)
    engine.play(others, range(5))
    same = company.start(1, seeds=[3], budgets_us=[9.0])
    together = np.concatenate([same, others[::-1]])
    for frame in range(5, 25):
        single, batch = engine_one.turn(one, frame), engine.turn(together, frame)
        np.testing.assert_allclose(single.action_NA[0], batch.action_NA[0], atol=1e-5)


def test_a_retry_gets_the_same_reply_and_advances_nothing(bundle: Bundle) -> None:
    clean, engine = Engine(Bots(bundle, max_bots=8)), Engine(Bots(bundle, max_bots=8))
    expected = clean.play(clean.bots.start(2), range(20))
    handles, played = engine.bots.start(2), []
    for frame in range(20):
        queries = engine.ask(handles, frame)
        assert engine.ask(handles, frame) is queries
        actions = engine.submit(handles, frame, queries)
        assert engine.submit(handles, frame, queries) is actions
        assert engine.ask(handles, frame) is queries
        played.append(queries.query_NM.tobytes() + queries.probs_NM.tobytes() + actions.action_NA.tobytes())
    assert played == expected


def test_a_reply_is_read_only_and_inputs_are_copied(engine: Engine) -> None:
    handles = engine.bots.start(2)
    free = engine.free(0, 2)
    queries = engine.bots.request_queries(handles, 0, free)
    with pytest.raises(ValueError, match="read-only"):
        queries.query_NM[0, 0] = True
    free[:] = 0.5
    with pytest.raises(errors.FrameReused):
        engine.bots.request_queries(handles, 0, free)


def test_a_newer_frame_abandons_a_pending_query(bundle: Bundle) -> None:
    """The context does not advance; rewards of the abandoned frame have been counted; both are counted."""
    clean, engine = Engine(Bots(bundle, max_bots=8)), Engine(Bots(bundle, max_bots=8))
    a, b = clean.bots.start(2), engine.bots.start(2)
    clean.turn(a, 0)
    engine.turn(b, 0)
    engine.ask(b, 3)
    later = engine.bots.request_queries(b, 4, engine.free(4, 2), engine.rewards(4, 2))
    both = engine.rewards(3, 2) + engine.rewards(4, 2)
    expected = clean.bots.request_queries(a, 4, clean.free(4, 2), both)
    assert np.array_equal(later.query_NM, expected.query_NM)
    assert np.array_equal(engine.submit(b, 4, later).action_NA, clean.submit(a, 4, expected).action_NA)
    assert engine.bots.counters.abandoned_queries == 2
    assert engine.bots.counters.skipped_frames == 4
    assert clean.bots.counters.skipped_frames == 6
    with pytest.raises(errors.StaleFrame):
        engine.ask(b, 3)


def test_bots_regroup_between_frames(engine: Engine) -> None:
    """A turn is shared by the bots of one message only until the next one."""
    handles = engine.bots.start(4)
    engine.turn(handles, 0)
    engine.turn(handles[:2], 1)
    engine.turn(handles[2:], 7)
    engine.turn(handles[[3, 0, 2, 1]], 8)
    assert engine.bots.counters.skipped_frames == 2 * 6 + 2 * 6 + 0
    engine.bots.stop(handles)
    assert engine.bots._turns._turns == {}


def test_a_frame_that_one_bot_began_alone_is_no_retry_of_all(engine: Engine) -> None:
    """Though the first bot's last turn was one of both: the same content does not get that turn's answer again."""
    handles = engine.bots.start(2)
    engine.turn(handles, 0)
    engine.bots.request_queries(handles[1:], 1, engine.free(1, 1))
    with pytest.raises(errors.FrameReused):
        engine.bots.request_queries(handles, 1, engine.free(0, 2), engine.rewards(0, 2))


def test_old_turns_are_forgotten(engine: Engine) -> None:
    handles = engine.bots.start(4)
    for frame in range(50):
        engine.turn(handles[: 1 + frame % 4], frame)
    assert len(engine.bots._turns._turns) <= 4


def test_infer_time_is_the_policys_on_the_injected_clock(bundle: Bundle) -> None:
    ticks = iter(range(0, 10**9, 7000))
    engine = Engine(Bots(bundle, max_bots=2, clock=lambda: next(ticks)))
    handles = engine.bots.start(1)
    queries = engine.ask(handles, 0)
    assert queries.infer_us == 7.0
    assert engine.submit(handles, 0, queries).infer_us == 7.0


@pytest.mark.parametrize("budget_us", [0.0, 0.3, 2.0, 9.0, 100.0])
def test_a_query_costs_what_it_says_and_at_most_the_budget(bundle: Bundle, budget_us: float) -> None:
    model = CostModel(0.25, (1.0, 2.0, 3.0, 4.0, 0.5))
    engine = Engine(Bots(bundle, max_bots=8))
    handles = engine.bots.start(6, budgets_us=[budget_us] * 6, cost_model=model)
    for frame in range(30):
        queries = engine.ask(handles, frame, frame_budget_us=3.0 * budget_us)
        np.testing.assert_allclose(queries.cost_us_N, model.query_cost_us(queries.query_NM))
        assert (queries.cost_us_N <= budget_us).all()
        assert queries.cost_us_N.sum() <= 3.0 * budget_us
        engine.submit(handles, frame, queries)


def test_default_budget_is_the_manifests(bundle: Bundle) -> None:
    engine = Engine(Bots(bundle, max_bots=8))
    handles, spent = engine.bots.start(8), []
    for frame in range(40):
        queries = engine.ask(handles, frame)
        spent.append(queries.cost_us_N.max())
        engine.submit(handles, frame, queries)
    assert 0.8 * bundle.manifest.budget_us < max(spent) <= bundle.manifest.budget_us


def test_a_budget_of_one_is_no_budget(tmp_path: Path) -> None:
    """All probabilities are 1: the whole table is asked for, rounding and call cost notwithstanding."""
    engine = Engine(Bots(Bundle.load(make_bundle(tmp_path / "free", budget=1.0)), max_bots=2))
    engine.bots._policy = Poisoned(engine.bots._policy)
    engine.bots._policy.query_probs = lambda batch: batch.probs_NM.fill(1.0)
    handles = engine.bots.start(1, cost_model=CostModel(1000.0, (0.1,) * 5))
    assert engine.ask(handles, 0).query_NM.all()


@pytest.mark.parametrize("number", [1.0, 1e30, -1e30, math.nan, math.inf, -math.inf])
def test_any_network_output_keeps_the_budget(engine: Engine, poisoned: Poisoned, number: float) -> None:
    handles = engine.bots.start(4, budgets_us=[8.0] * 4)
    poisoned.probs = {0: number, 2: number}
    for frame in range(20):
        queries = engine.ask(handles, frame, frame_budget_us=11.0)
        assert (queries.cost_us_N <= 8.0).all()
        assert queries.cost_us_N.sum() <= 11.0
        engine.submit(handles, frame, queries)
