"""γ as printed in Algorithm 1, and the control that settles where the budget is spent."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from training.control import Control, Spent, draw_costs

ONES = torch.ones(1, 1)
ONLY = torch.zeros(1, dtype=torch.long)


@given(st.lists(st.floats(0, 1, width=32), max_size=30), st.floats(1e-4, 1), st.floats(0, 1, width=32))
def test_algorithm_1_never_falls_and_counts_violations(costs: list[float], step: float, budget: float) -> None:
    control, target = Control.of("algorithm-1", step, 1), torch.tensor([budget])
    for cost in costs:
        before = control.weights[0]
        control.observe(torch.full((1, 1), cost), target, ONLY, ONES)
        assert control.weights[0] == (before + step if cost > budget else before)
    assert control.weights[0] == pytest.approx(step * sum(cost > budget for cost in costs))


@pytest.mark.parametrize(("budget", "worth"), [(0.5, 1.0), (0.1, 5.0), (0.01, 40.0)])
def test_dual_settles_where_the_budget_is_spent(budget: float, worth: float) -> None:
    """A learner that spends `budget` when γ is `worth`, more when it is less; noisy, and slower than the control."""
    chance, control, cost = np.random.default_rng(0), Control.of("dual", 0.01, 1), 0.5
    spent = []
    for _ in range(4000):
        cost += 0.02 * (min(0.9, budget * (worth / control.weights[0])) - cost)
        seen = torch.full((1, 1), float(cost * chance.uniform(0.5, 1.5)))
        control.observe(seen, torch.tensor([budget]), ONLY, ONES)
        spent.append(cost)
    assert np.mean(spent[-500:]) == pytest.approx(budget, rel=0.1)
    assert control.weights[0] == pytest.approx(worth, rel=0.2)


@given(st.floats(0, 1, width=32), st.floats(0, 1, width=32), st.floats(1e-4, 0.1))
def test_dual_moves_towards_the_constraint_by_a_bounded_step(cost: float, budget: float, step: float) -> None:
    control = Control.of("dual", step, 1)
    before = control.weights[0]
    control.observe(torch.full((1, 1), cost), torch.tensor([budget]), ONLY, ONES)
    moved = np.arcsinh(control.weights[0] / 0.02) - np.arcsinh(before / 0.02)
    assert abs(moved) <= step + 1e-9
    assert moved == pytest.approx(0.0, abs=1e-9) or (moved > 0) == (cost > budget)


@pytest.mark.parametrize("floor", [-0.1, -1.0, 0.0])
def test_dual_pays_for_asking_where_a_budget_is_left_over(floor: float) -> None:
    control = Control.of("dual", 0.01, 1, floor)
    for _ in range(1000):
        control.observe(torch.zeros(1, 1), torch.tensor([0.4]), ONLY, ONES)
    assert control.weights[0] == pytest.approx(floor)


def test_each_stratum_has_its_own_weight_and_padding_is_not_spent() -> None:
    control = Control.of("algorithm-1", 1.0, 3)
    cost = torch.tensor([[0.9, 0.0], [0.1, 0.9], [0.1, 0.1]])
    valid = torch.tensor([[1.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    target, stratum = torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0, 1, 1])
    control.observe(cost, target, stratum, valid)
    assert control.weights == [1.0, 0.0, 0.0]
    added = control.penalty(cost, target, stratum, valid)
    assert Spent(cost, target, stratum, valid).means(0)["phi"] == pytest.approx(0.4 / 5)
    assert added.item() == pytest.approx(0.4 / 5)


def test_dual_counts_neither_what_padding_spends_nor_what_it_may() -> None:
    """Without it the first row asks for exactly its C; with what it asks for, or may, past its end it would not."""
    control = Control("dual", 0.01, -0.1, [2.0])
    cost, valid = torch.tensor([[0.5, 0.9]]), torch.tensor([[1.0, 0.0]])
    control.observe(cost, torch.tensor([0.5]), torch.tensor([0]), valid)
    assert control.weights == pytest.approx([2.0])


def test_target_costs_are_spread_evenly_over_orders_of_magnitude() -> None:
    costs, _ = draw_costs((0.01, 1.0), 20_000, np.random.default_rng(0))
    assert np.quantile(np.log10(costs), [0.25, 0.5, 0.75]) == pytest.approx([-1.5, -1.0, -0.5], abs=0.05)


def test_dual_penalty_is_the_signed_excess_of_the_mean() -> None:
    control = Control("dual", 0.01, -0.1, [2.0, 10.0])
    cost, target = torch.tensor([[0.2, 0.4], [0.0, 0.0]]), torch.tensor([0.1, 0.05])
    added = control.penalty(cost, target, torch.tensor([0, 1]), torch.ones(2, 2))
    assert added.item() == pytest.approx((2.0 * (0.1 + 0.3) - 10.0 * 0.1) / 4)


@given(st.integers(1, 40), st.integers(0, 1000))
def test_target_costs_cover_every_stratum_and_stay_in_it(groups: int, seed: int) -> None:
    edges = (0.003, 0.01, 0.1, 1.0)
    costs, strata = draw_costs(edges, groups, np.random.default_rng(seed))
    low, high = np.array(edges)[strata], np.array(edges)[strata + 1]
    assert (costs >= low * (1 - 1e-6)).all()
    assert (costs <= high * (1 + 1e-6)).all()
    counts = np.bincount(strata, minlength=3)
    assert counts.max() - counts.min() <= 1
