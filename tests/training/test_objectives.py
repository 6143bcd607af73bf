"""The objective against oracles of a few lines, written from the paper."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from training.objectives import action_loss, penalty, query_cost, straight_through

bits = st.lists(st.integers(0, 1), min_size=3, max_size=3)


@given(st.lists(bits, min_size=1, max_size=6), st.floats(0, 1), st.lists(st.floats(0.1, 9), min_size=3, max_size=3))
def test_penalty_is_equation_2(queries: list[list[int]], budget: float, costs: list[float]) -> None:
    query = torch.tensor([queries], dtype=torch.float64)
    cost = query_cost(query, torch.tensor(costs, dtype=torch.float64))
    expected = [sum(q * f for q, f in zip(row, costs, strict=True)) / sum(costs) for row in queries]
    assert cost[0].tolist() == pytest.approx(expected)
    phi = penalty(cost, budget, torch.ones(1, len(queries)))
    assert phi.item() == pytest.approx(sum(max(c - budget, 0) for c in expected) / len(queries))


def test_padding_changes_neither_loss_nor_penalty() -> None:
    torch.manual_seed(0)
    losses, cost = torch.rand(2, 5), torch.rand(2, 5)
    valid = torch.tensor([[1, 1, 1, 0, 0], [1, 1, 1, 1, 1.0]])
    other_losses, other_cost = losses.clone(), cost.clone()
    other_losses[0, 3:] += 100
    other_cost[0, 3:] = 1
    assert torch.equal(action_loss(losses, valid), action_loss(other_losses, valid))
    assert torch.equal(penalty(cost, 0.3, valid), penalty(other_cost, 0.3, valid))
    alone = slice(0, 1), slice(0, 3)  # the first row without its padding
    assert penalty(cost[:1], 0.3, valid[:1]).item() == pytest.approx(penalty(cost[alone], 0.3, valid[alone]).item())
    assert action_loss(losses[:1], valid[:1]).item() == pytest.approx(losses[alone].mean().item())


def test_straight_through_is_the_sample_in_value_and_the_probability_in_gradient() -> None:
    probs = torch.tensor([0.2, 0.7], requires_grad=True)
    query = straight_through(torch.tensor([1.0, 0.0]), probs)
    assert query.tolist() == pytest.approx([1.0, 0.0])
    (query * torch.tensor([3.0, 5.0])).sum().backward()
    assert probs.grad is not None
    assert probs.grad.tolist() == [3.0, 5.0]
