"""Parallel sampling and its gradient equal the paper's sequential loop."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from training.acquisition import (
    Rollout,
    backward,
    rollout,
    sample_queries,
    sample_queries_incrementally,
    sample_queries_sequentially,
)
from training.allocation import fit_bots, fit_frames
from training.models import BudgetedDecisionTransformer
from training.objectives import action_loss, penalty, query_cost
from training.policy import Known, ModelConfig

F, M = 3, 4
OWNER = (0, 0, 1, 2, 3, 3)


def network(
    seed: int,
    *,
    context_length: int = 4,
    n_layers: int = 2,
    n_heads: int = 2,
    n_kv_heads: int | None = None,
    spread: float = 1.0,
    acquisition: str = "learned",
) -> BudgetedDecisionTransformer:
    """Random weights, with an acquisition head that depends strongly on the past."""
    torch.manual_seed(seed)
    config = ModelConfig(
        octaves=(1, 0, 2),
        owner=OWNER,
        n_queries=M,
        bins=(5, 2),
        low=(-1.0, 0.0),
        high=(1.0, 1.0),
        sampled=(False, True),
        context_length=context_length,
        width=8,
        n_layers=n_layers,
        n_heads=n_heads,
        n_kv_heads=n_kv_heads,
        encoder_width=16,
        acquisition=acquisition,
        target_cost=0.3,
        cost_range=(0.01, 1.0),
    )
    model = BudgetedDecisionTransformer(config)
    torch.nn.init.normal_(model.acquisition_head.out.weight, std=spread)
    for block in model.blocks:
        torch.nn.init.normal_(block.attention.age_bias, std=1.0)
        torch.nn.init.normal_(block.attention.out.weight, std=0.5)
        torch.nn.init.normal_(block.mlp[-1].weight, std=0.5)
    return model


def batch(seed: int, size: int, length: int) -> tuple[torch.Tensor, ...]:
    """free, costly, returns_to_go, uniforms, actions."""
    g = torch.Generator().manual_seed(seed)
    return (
        torch.randn(size, length, F, generator=g),
        torch.randn(size, length, len(OWNER), generator=g),
        torch.randn(size, length, 1, generator=g),
        torch.rand(size, length, M, generator=g),
        torch.rand(size, length, 2, generator=g),
    )


def know(model: BudgetedDecisionTransformer, free: torch.Tensor, costly: torch.Tensor, togo: torch.Tensor) -> Known:
    """A target cost of its own for every sequence."""
    target = torch.linspace(0.05, 0.9, len(free))[:, None, None].expand_as(togo)
    return model.know(free, togo, target, costly)


COSTS = torch.tensor([1.0, 2.0, 1.0, 3.0])


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10_000),
    st.integers(1, 12),
    st.integers(2, 6),
    st.integers(1, 3),
    st.sampled_from([0.1, 1.0, 5.0]),
    st.sampled_from(["none", "bot", "frame"]),
    st.sampled_from([None, 1]),
)
def test_same_noise_same_queries(
    seed: int, length: int, context_length: int, n_layers: int, spread: float, allocation: str, n_kv_heads: int | None
) -> None:
    """The property that makes parallel training exact, with and without the runtime's allocation in the loop."""
    model = network(seed, context_length=context_length, n_layers=n_layers, n_kv_heads=n_kv_heads, spread=spread)
    free, costly, togo, uniforms, _ = batch(seed, 4, length)
    known = know(model, free, costly, togo)
    targets = known.target_cost[:, 0, 0]
    fit = {"none": None, "bot": fit_bots(COSTS, targets), "frame": fit_frames(COSTS, targets, 2)}[allocation]
    query, passes = sample_queries(model, known, uniforms, fit)
    with torch.no_grad():
        reference = sample_queries_sequentially(model, known, uniforms, fit)
    assert torch.equal(query, reference.query_BTM.round())
    assert passes <= length
    assert torch.equal(sample_queries_incrementally(model, known, uniforms, fit)[0], query)
    assert torch.allclose(rollout(model, known, query).hidden_BTW, reference.hidden_BTW, atol=1e-5)


@given(st.integers(0, 10_000), st.integers(1, 3))
def test_what_is_sampled_fits_its_budget(seed: int, bots: int) -> None:
    g = torch.Generator().manual_seed(seed)
    probs, target = torch.rand(2 * bots, M, generator=g), torch.rand(2 * bots, generator=g)
    sampled = (torch.rand(probs.shape, generator=g) < probs).float()
    alone, together = fit_bots(COSTS, target)(probs, sampled), fit_frames(COSTS, target, bots)(probs, sampled)
    assert ((alone <= sampled) & (together <= sampled)).all()
    assert (query_cost(alone, COSTS) <= target + 1e-6).all()
    spent, allowed = query_cost(together, COSTS).view(2, bots).sum(1), target.view(2, bots).sum(1)
    assert (spent <= allowed + 1e-6).all()
    fits = query_cost(sampled, COSTS).view(2, bots).sum(1) < allowed - 1e-5
    assert (together.view(2, bots, M)[fits] == sampled.view(2, bots, M)[fits]).all(), "what fits is left as it is"


def objective(model: BudgetedDecisionTransformer, actions: torch.Tensor, gamma: float):
    def loss(sampled: Rollout) -> torch.Tensor:
        valid = torch.ones(actions.shape[:2])
        cost = query_cost(sampled.query_BTM, COSTS)
        delta = action_loss(model.action_head.losses(sampled.hidden_BTW, actions), valid)
        return delta + gamma * penalty(cost, 0.2, valid)

    return loss


def gradients(model: BudgetedDecisionTransformer) -> dict[str, torch.Tensor]:
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("allocated", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_enough_sweeps_give_the_sequential_gradient(seed: int, allocated: bool) -> None:
    length = 7
    model = network(seed)
    free, costly, togo, uniforms, actions = batch(seed, 2, length)
    loss = objective(model, actions, gamma=0.7)
    fit = fit_frames(COSTS, torch.tensor([0.2, 0.4]), 2) if allocated else None
    reference = sample_queries_sequentially(model, know(model, free, costly, togo), uniforms, fit)
    value = loss(reference)
    value.backward()
    expected = gradients(model)
    model.zero_grad()
    query, _ = sample_queries(model, know(model, free, costly, togo), uniforms, fit)
    sampled = rollout(model, know(model, free, costly, togo), query.requires_grad_())
    again = loss(sampled)
    assert again.item() == pytest.approx(value.item(), rel=1e-5)
    backward(sampled, again, length, list(model.parameters()))
    for name, gradient in gradients(model).items():
        assert torch.allclose(gradient, expected[name], rtol=1e-3, atol=1e-5), name


def test_penalty_moves_the_acquisition_path_only() -> None:
    model = network(0)
    free, costly, togo, uniforms, actions = batch(0, 2, 6)

    def run(gamma: float) -> dict[str, torch.Tensor]:
        model.zero_grad()
        query, _ = sample_queries(model, know(model, free, costly, togo), uniforms)
        sampled = rollout(model, know(model, free, costly, togo), query.requires_grad_())
        backward(sampled, objective(model, actions, gamma)(sampled), 2, list(model.parameters()))
        return gradients(model)

    without, with_penalty = run(0.0), run(5.0)
    assert torch.equal(without["action_head.weight"], with_penalty["action_head.weight"])
    name = "acquisition_head.out.weight"
    assert without[name].abs().sum() > 0, "the action loss must reach the acquisition head through the estimator"
    assert not torch.allclose(without[name], with_penalty[name])


@pytest.mark.parametrize(("acquisition", "value"), [("all", 1.0), ("none", 0.0)])
def test_forced_acquisition(acquisition: str, value: float) -> None:
    model = network(0, acquisition=acquisition)
    free, costly, togo, uniforms, actions = batch(0, 2, 6)
    known = know(model, free, costly, togo)
    query, _ = sample_queries(model, known, uniforms)
    assert (query == value).all()
    sampled = rollout(model, known, query.requires_grad_())
    assert (sampled.probs_BTM == value).all()
    backward(sampled, objective(model, actions, 0.0)(sampled), 2, list(model.parameters()))
    assert model.action_head.weight.grad is not None


def test_random_acquisition_draws_every_feature_with_probability_c() -> None:
    model = network(0, acquisition="random")
    free, costly, togo, uniforms, _ = batch(0, 5, 400)
    known = know(model, free, costly, togo)
    query, _ = sample_queries_incrementally(model, known, uniforms)
    assert torch.allclose(query.mean((1, 2)), known.target_cost[:, 0, 0], atol=0.04)
    assert torch.equal(query, (uniforms < known.target_cost).float())
