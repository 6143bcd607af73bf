"""Bots of a bundle that serves every budget: the target cost reaches the network, and the budget stays hard."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol import errors
from tests.bot_runtime.conftest import Engine

FULL_US = 1.25 + 2.5 + 7.1 + 11.3 + 0.3


def first_probs(bundle: Bundle, start: dict[str, object], **frame: object) -> np.ndarray:
    engine = Engine(Bots(bundle, max_bots=2))
    return engine.ask(engine.bots.start(2, seeds=[1, 2], **start), 0, **frame).probs_NM


@pytest.mark.parametrize(
    ("start", "frame"),
    [
        ({"target_costs_us": [0.25 * FULL_US] * 2}, {}),
        ({"budgets_us": [0.25 * FULL_US] * 2}, {}),
        ({}, {"target_costs_us": [0.25 * FULL_US] * 2}),
        ({}, {"budgets_us": [0.25 * FULL_US] * 2}),
        ({"target_costs_us": [1e9] * 2}, {"frame_budget_us": 0.5 * FULL_US}),
    ],
)
def test_the_network_reads_the_target_cost_whoever_says_it(conditioned: Bundle, start: dict, frame: dict) -> None:
    """Each says what the bundle's default is, and must come out as that does."""
    default = first_probs(conditioned, {})
    np.testing.assert_allclose(first_probs(conditioned, start, **frame), default, atol=1e-6)
    for other in (0.0, 0.5, 1.0):
        assert np.abs(first_probs(conditioned, {}, target_costs_us=[other * FULL_US] * 2) - default).max() > 1e-2


def test_each_bot_has_its_own(conditioned: Bundle) -> None:
    mixed = first_probs(conditioned, {}, target_costs_us=[0.0, FULL_US])
    np.testing.assert_allclose(mixed[0], first_probs(conditioned, {}, target_costs_us=[0.0, 0.0])[0], atol=1e-6)
    np.testing.assert_allclose(mixed[1], first_probs(conditioned, {}, target_costs_us=[FULL_US] * 2)[1], atol=1e-6)


@pytest.mark.parametrize("kind", ["bundle", "memoryless"])
def test_a_bundle_for_one_budget_takes_no_notice(kind: str, request: pytest.FixtureRequest) -> None:
    bundle = request.getfixturevalue(kind)
    asked = first_probs(bundle, {"target_costs_us": [0.0, 1.0]}, target_costs_us=[2.0, 3.0])
    assert np.array_equal(asked, first_probs(bundle, {}))


@pytest.mark.parametrize("kind", ["bundle", "memoryless", "conditioned"])
def test_a_budget_of_one_frame_is_hard_and_of_that_frame_only(kind: str, request: pytest.FixtureRequest) -> None:
    engine = Engine(Bots(request.getfixturevalue(kind), max_bots=4))
    handles = engine.bots.start(4, budgets_us=[12.0] * 4)
    random, most_us = np.random.default_rng(0), np.zeros(2)
    for frame in range(60):
        budgets_us = random.uniform(0.0, 25.0, 4)
        limits = {"budgets_us": budgets_us, "target_costs_us": [1e9] * 4} if frame % 2 else {}
        queries = engine.ask(handles, frame, **limits)
        assert (queries.cost_us_N <= (budgets_us if frame % 2 else 12.0)).all()
        most_us[frame % 2] = max(most_us[frame % 2], queries.cost_us_N.max())
        engine.submit(handles, frame, queries)
    assert 0.0 < most_us[0] <= 12.0 < most_us[1]


def test_a_frames_limits_leave_nothing_behind(conditioned: Bundle) -> None:
    """Wide limits that change nothing in one frame, and the play after it is that of bots which never had any."""
    clean, engine = (Engine(Bots(conditioned, max_bots=2)) for _ in range(2))
    a, b = (each.bots.start(2, budgets_us=[1e6] * 2) for each in (clean, engine))
    expected = clean.turn(a, 0)
    queries = engine.ask(b, 0, budgets_us=[1e7] * 2, target_costs_us=[FULL_US] * 2, frame_budget_us=1e8)
    assert np.array_equal(engine.submit(b, 0, queries).action_NA, expected.action_NA)
    assert engine.play(b, range(1, 8)) == clean.play(a, range(1, 8))


@pytest.mark.parametrize("name", ["budgets_us", "target_costs_us"])
def test_a_retry_repeats_the_limits_of_the_frame(conditioned: Bundle, name: str) -> None:
    engine = Engine(Bots(conditioned, max_bots=2))
    handles = engine.bots.start(2)

    def asks(frame: int, **limits: object) -> Callable[[], object]:
        return lambda: engine.ask(handles, frame, **limits)

    said = asks(0, **{name: [5.0, 9.0]})
    queries = said()
    assert said() is queries
    for other in (asks(0), asks(0, **{name: [5.0, 9.5]}), asks(0, **{name: [5.0, 9.0]}, frame_budget_us=1e9)):
        with pytest.raises(errors.FrameReused, match="other content"):
            other()
    both = {"budgets_us": [5.0, 9.0], "target_costs_us": [5.0, 9.0]}
    with pytest.raises(errors.FrameReused, match="other content"):
        asks(0, **both)()
    engine.submit(handles, 0, queries)
    asks(1)()
    with pytest.raises(errors.FrameReused, match="other content"):
        asks(1, **{name: [5.0, 9.0]})()
