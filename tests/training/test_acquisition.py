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
from training.models import BudgetedDecisionTransformer, ModelConfig
from training.objectives import action_loss, penalty, query_cost

F, M = 3, 4
OWNER = (0, 0, 1, 2, 3, 3)


def network(
    seed: int, *, context_length: int = 4, n_layers: int = 2, spread: float = 1.0
) -> BudgetedDecisionTransformer:
    """Random weights, with an acquisition head that depends strongly on the past."""
    torch.manual_seed(seed)
    config = ModelConfig(
        n_free=F,
        owner=OWNER,
        n_queries=M,
        bins=(5, 2),
        low=(-1.0, 0.0),
        high=(1.0, 1.0),
        sampled=(False, True),
        context_length=context_length,
        width=8,
        n_layers=n_layers,
        n_heads=2,
        encoder_width=16,
        fourier=1,
    )
    model = BudgetedDecisionTransformer(config)
    torch.nn.init.normal_(model.acquisition_head[-1].weight, std=spread)
    for block in model.blocks:
        torch.nn.init.normal_(block.attention.age_bias, std=1.0)
        torch.nn.init.normal_(block.attention.out.weight, std=0.5)
        torch.nn.init.normal_(block.mlp[-1].weight, std=0.5)
    return model


def batch(seed: int, size: int, length: int) -> tuple[torch.Tensor, ...]:
    """free, costly, returns_to_go, uniforms, bins."""
    g = torch.Generator().manual_seed(seed)
    return (
        torch.randn(size, length, F, generator=g),
        torch.randn(size, length, len(OWNER), generator=g),
        torch.randn(size, length, 1, generator=g),
        torch.rand(size, length, M, generator=g),
        torch.randint(0, 2, (size, length, 2), generator=g),
    )


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10_000), st.integers(1, 12), st.integers(2, 6), st.integers(1, 3), st.sampled_from([0.1, 1.0, 5.0])
)
def test_same_noise_same_queries(seed: int, length: int, context_length: int, n_layers: int, spread: float) -> None:
    model = network(seed, context_length=context_length, n_layers=n_layers, spread=spread)
    free, costly, togo, uniforms, _ = batch(seed, 3, length)
    context = model.context(free, togo)
    query, passes = sample_queries(model, context, costly, uniforms)
    with torch.no_grad():
        reference = sample_queries_sequentially(model, context, costly, uniforms)
    assert torch.equal(query, reference.query_BTM.round())
    assert passes <= length
    assert torch.equal(sample_queries_incrementally(model, context, costly, uniforms)[0], query)
    assert torch.allclose(rollout(model, context, costly, query).hidden_BTW, reference.hidden_BTW, atol=1e-5)


def objective(model: BudgetedDecisionTransformer, bins: torch.Tensor, gamma: float):
    def loss(sampled: Rollout) -> torch.Tensor:
        valid = torch.ones(bins.shape[:2])
        cost = query_cost(sampled.query_BTM, torch.tensor([1.0, 2.0, 1.0, 3.0]))
        return action_loss(model.action_logits(sampled.hidden_BTW), bins, valid) + gamma * penalty(cost, 0.2, valid)

    return loss


def gradients(model: BudgetedDecisionTransformer) -> dict[str, torch.Tensor]:
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("seed", range(4))
def test_enough_sweeps_give_the_sequential_gradient(seed: int) -> None:
    length = 7
    model = network(seed)
    free, costly, togo, uniforms, bins = batch(seed, 2, length)
    loss = objective(model, bins, gamma=0.7)
    reference = sample_queries_sequentially(model, model.context(free, togo), costly, uniforms)
    value = loss(reference)
    value.backward()
    expected = gradients(model)
    model.zero_grad()
    query, _ = sample_queries(model, model.context(free, togo), costly, uniforms)
    sampled = rollout(model, model.context(free, togo), costly, query.requires_grad_())
    assert backward(sampled, loss, sweeps=length).item() == pytest.approx(value.item(), rel=1e-5)
    for name, gradient in gradients(model).items():
        assert torch.allclose(gradient, expected[name], rtol=1e-3, atol=1e-5), name


def test_penalty_moves_the_acquisition_path_only() -> None:
    model = network(0)
    free, costly, togo, uniforms, bins = batch(0, 2, 6)

    def run(gamma: float) -> dict[str, torch.Tensor]:
        model.zero_grad()
        query, _ = sample_queries(model, model.context(free, togo), costly, uniforms)
        context = model.context(free, togo)
        backward(rollout(model, context, costly, query.requires_grad_()), objective(model, bins, gamma), sweeps=2)
        return gradients(model)

    without, with_penalty = run(0.0), run(5.0)
    assert torch.equal(without["action_head.weight"], with_penalty["action_head.weight"])
    name = "acquisition_head.2.weight"
    assert without[name].abs().sum() > 0, "the action loss must reach the acquisition head through the estimator"
    assert not torch.allclose(without[name], with_penalty[name])


@pytest.mark.parametrize(("acquisition", "value"), [("all", 1.0), ("none", 0.0)])
def test_forced_acquisition(acquisition: str, value: float) -> None:
    import dataclasses

    model = network(0)
    model.config = dataclasses.replace(model.config, acquisition=acquisition)
    free, costly, togo, uniforms, bins = batch(0, 2, 6)
    query, _ = sample_queries(model, model.context(free, togo), costly, uniforms)
    assert (query == value).all()
    sampled = rollout(model, model.context(free, togo), costly, query.requires_grad_())
    assert (sampled.probs_BTM == value).all()
    backward(sampled, objective(model, bins, 0.0), sweeps=2)
    assert model.action_head.weight.grad is not None
