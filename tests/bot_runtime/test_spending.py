"""Which budget and which target cost count, against the rule in words."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bot_runtime.bundle import Bundle
from bot_runtime.costs import Costs
from bot_runtime.spending import Limits, Spending
from protocol.features import CostModel

N = 2
MODEL = CostModel(16.0, (4.0, 5.0, 6.0, 7.0, 12.0))  # 50 µs in all
NOTHING = Limits.checked(N, None, None)
microseconds = st.floats(0.0, 100.0) | st.sampled_from([0.0, 50.0, 1e9])
per_bot = st.none() | st.lists(microseconds, min_size=N, max_size=N)
SLOTS = np.array([2, 0])


def spending(bundle: Bundle, model: CostModel = MODEL, started: Limits = NOTHING) -> Spending:
    rows = Spending(bundle.manifest, 4)
    rows.begin(SLOTS, model, started)
    return rows


@given(per_bot, per_bot, per_bot, per_bot, st.none() | microseconds)
def test_the_rule(
    conditioned: Bundle,
    start_budgets: list[float] | None,
    start_targets: list[float] | None,
    frame_budgets: list[float] | None,
    frame_targets: list[float] | None,
    shared: float | None,
) -> None:
    rows = spending(conditioned, started=Limits.checked(N, start_budgets, start_targets))
    terms = rows.terms(SLOTS, Limits.checked(N, frame_budgets, frame_targets, shared))
    for bot in range(N):
        said = [None if numbers is None else numbers[bot] for numbers in (frame_targets, frame_budgets)]
        said += [None if numbers is None else numbers[bot] for numbers in (start_targets, start_budgets)]
        first = next(us for us in [*said, 0.25 * 50.0] if us is not None)
        budget = next((us for us in (said[1], said[3]) if us is not None), np.inf)
        part = np.inf if shared is None else shared / N
        assert terms.budgets_N[bot] == budget
        assert terms.target_cost_N[bot] == np.float32(min(first, budget, part, 50.0) / 50.0)
    assert terms.target_cost_N.dtype == np.float32


@pytest.mark.parametrize(
    ("start", "frame", "share"),
    [
        ({}, {}, 0.25),
        ({"budgets_us": [20.0, 20.0]}, {}, 0.4),
        ({"budgets_us": [20.0, 20.0], "target_costs_us": [10.0, 10.0]}, {}, 0.2),
        ({"budgets_us": [20.0, 20.0], "target_costs_us": [30.0, 30.0]}, {}, 0.4),
        ({"target_costs_us": [10.0, 10.0]}, {"budgets_us": [40.0, 40.0]}, 0.8),
        ({"target_costs_us": [10.0, 10.0]}, {"budgets_us": [40.0, 40.0], "target_costs_us": [5.0, 5.0]}, 0.1),
        ({"budgets_us": [20.0, 20.0]}, {"target_costs_us": [25.0, 25.0]}, 0.4),
        ({"budgets_us": [20.0, 20.0]}, {"budgets_us": [30.0, 30.0]}, 0.6),
        ({}, {"frame_budget_us": 20.0}, 0.2),
        ({}, {"target_costs_us": [60.0, 1e9]}, 1.0),
    ],
)
def test_the_rule_by_example(conditioned: Bundle, start: dict, frame: dict, share: float) -> None:
    unsaid = {"budgets_us": None, "target_costs_us": None}
    rows = spending(conditioned, started=Limits.checked(N, **(unsaid | start)))
    terms = rows.terms(SLOTS, Limits.checked(N, **(unsaid | frame)))
    assert terms.target_cost_N == pytest.approx(share)


def test_shares_are_of_each_bots_own_full_cost(conditioned: Bundle) -> None:
    rows = spending(conditioned)
    rows.begin(np.array([1]), CostModel(0.0, (1.0, 0.0, 0.0, 0.0, 1.0)), Limits.checked(1, None, [1.0]))
    rows.begin(np.array([3]), CostModel(0.0, (0.0,) * 5), Limits.checked(1, [0.0], None))
    terms = rows.terms(np.array([3, 1, 0]), Limits.checked(3, None, None))
    assert terms.target_cost_N.tolist() == [1.0, 0.5, 0.25]
    assert terms.calls_N.tolist() == [0.0, 0.0, 16.0]


def test_the_smallest_costs_do_not_overflow(conditioned: Bundle) -> None:
    tiny = CostModel(0.0, (5e-324, 0.0, 0.0, 0.0, 0.0))
    assert spending(conditioned, tiny).terms(SLOTS, Limits.checked(N, [1e9] * N, None)).target_cost_N.tolist() == [1, 1]


def test_measured_costs_replace_the_bots_own(conditioned: Bundle) -> None:
    rows, measured = spending(conditioned), Costs(CostModel(1.0, (3.0,) * 5))
    terms = rows.terms(SLOTS, Limits.checked(N, [8.0, 4.0], None), measured)
    assert terms.costs_NM.tolist() == [[3.0] * 5] * N
    assert terms.calls_N.tolist() == [1.0] * N
    assert terms.target_cost_N.tolist() == [0.5, 0.25]  # of 16 µs in all
    assert rows.terms(SLOTS, NOTHING).calls_N.tolist() == [16.0] * N
