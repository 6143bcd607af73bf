"""The ladder, and features that were not acquired: what a bot does when something is missing or not a number."""

from __future__ import annotations

import math

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.fallback import Reason
from tests.bot_runtime.conftest import Engine, Poisoned


def test_an_unacquired_value_never_changes_the_action(bundle: Bundle) -> None:
    results = []
    for filler in (0.0, 0.5, math.nan, math.inf, -1e30):
        engine = Engine(Bots(bundle, max_bots=8))
        handles, played = engine.bots.start(3), []
        for frame in range(12):
            queries = engine.ask(handles, frame)
            known = queries.query_NM[:, engine.table.owner]
            costly = np.where(known, engine.costly(frame, 3), np.float32(filler))
            played.append(engine.bots.submit_features(handles, frame, queries.query_NM, costly).action_NA.tobytes())
        results.append(played)
    assert all(played == results[0] for played in results)


def test_an_acquired_value_changes_the_action(engine: Engine) -> None:
    handles = engine.bots.start(2, seeds=[1, 1])
    queries = engine.bots.request_queries(handles, 0, np.zeros((2, engine.table.n_free), dtype=np.float32))
    assert queries.query_NM.any()
    costly = np.zeros((2, engine.table.n_costly), dtype=np.float32)
    costly[1] = 1.0
    actions = engine.bots.submit_features(handles, 0, queries.query_NM, costly)
    assert np.abs(actions.action_NA[0] - actions.action_NA[1]).max() > 1e-4


def test_a_failed_feature_is_as_if_never_asked_for(bundle: Bundle) -> None:
    """Not sent and failed = sent and failed; both differ from acquired."""
    actions = []
    for send in (True, False, None):
        engine = Engine(Bots(bundle, max_bots=8))
        handles = engine.bots.start(2)
        queries = engine.ask(handles, 0)
        failed = np.zeros_like(queries.query_NM)
        failed[0, np.argmax(queries.query_NM[0])] = send is not None
        acquired = queries.query_NM if send in (True, None) else queries.query_NM & ~failed
        costly = engine.costly(0, 2)
        actions.append(engine.bots.submit_features(handles, 0, acquired, costly, failed).action_NA.tobytes())
    assert actions[0] == actions[1] != actions[2]


@pytest.mark.parametrize("field", ["action_NA", "hidden_NW", "keys", "values"])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_step_that_is_not_finite_is_not_taken(bundle: Bundle, field: str, number: float) -> None:
    """The bot repeats its last action, and then plays on as if the bad frame had been abandoned."""
    clean, engine = Engine(Bots(bundle, max_bots=8)), Engine(Bots(bundle, max_bots=8))
    poison = engine.bots._policy = Poisoned(engine.bots._policy)
    a, b = clean.bots.start(3), engine.bots.start(3)
    last = [(clean.turn(a, frame), engine.turn(b, frame)) for frame in range(6)][-1][1]
    poison.step = {1: (field, number)}
    bad = engine.turn(b, 6)
    poison.step = {}
    assert bad.reasons_N.tolist() == [Reason.LEARNED, Reason.NON_FINITE_STEP_LAST_ACTION, Reason.LEARNED]
    assert np.array_equal(bad.action_NA[1], last.action_NA[1])
    np.testing.assert_allclose(bad.action_NA[0], clean.turn(a[[0, 2]], 6).action_NA[0], atol=1e-5)
    assert np.isfinite(bad.action_NA).all()
    clean.bots.request_queries(a[1:2], 6, clean.free(6, 3)[1:2], clean.rewards(6, 3)[1:2])
    for frame in range(7, 15):
        alone = clean.bots.request_queries(a[1:2], frame, clean.free(frame, 3)[1:2], clean.rewards(frame, 3)[1:2])
        answer = clean.bots.submit_features(a[1:2], frame, alone.query_NM, clean.costly(frame, 3)[1:2])
        np.testing.assert_allclose(engine.turn(b, frame).action_NA[1], answer.action_NA[0], atol=1e-5)


def test_without_a_last_action_the_safe_one(engine: Engine, poisoned: Poisoned) -> None:
    handles = engine.bots.start(2)
    poisoned.step = {0: ("action_NA", math.nan)}
    actions = engine.turn(handles, 0)
    assert actions.reasons_N.tolist() == [Reason.NON_FINITE_STEP_SAFE_ACTION, Reason.LEARNED]
    assert actions.action_NA[0].tolist() == [0.0, 0.5, 0.0]
    assert engine.bots.counters.reasons[Reason.NON_FINITE_STEP_SAFE_ACTION] == 1
    assert engine.bots.counters.reasons[Reason.LEARNED] == 1


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_probabilities_that_are_not_finite_ask_for_nothing(engine: Engine, poisoned: Poisoned, number: float) -> None:
    handles = engine.bots.start(3)
    engine.turn(handles, 0)
    poisoned.probs = {1: number}
    for frame in range(1, 9):  # only one of its probabilities is spoilt, so noise alone would not stop it for long
        queries = engine.ask(handles, frame)
        assert not queries.query_NM[1].any()
        assert queries.cost_us_N[1] == 0.0
        actions = engine.submit(handles, frame, queries)
        assert actions.reasons_N.tolist() == [Reason.LEARNED, Reason.NON_FINITE_QUERY, Reason.LEARNED]
    poisoned.probs = {}
    assert not engine.turn(handles, 9).reasons_N.any()


def test_actions_stay_within_what_the_bundle_declares(engine: Engine, poisoned: Poisoned) -> None:
    handles = engine.bots.start(2)
    poisoned.step = {0: ("action_NA", 7.0), 1: ("action_NA", -7.0)}
    actions = engine.turn(handles, 0)
    assert actions.action_NA[:, -1].tolist() == [1.0, 0.0]
    assert not actions.reasons_N.any()
