"""Sampling queries along a sequence, and their gradients: exactly, without recomputing the past at every timestep.

q_t depends on h_{t-1}, which depends on the queries before t. With the uniform noise u fixed, q = [u < q̃(q)] has one
fixed point, because the system is causal: after p parallel passes the first p timesteps are final. `sample_queries`
iterates to it; `sample_queries_incrementally` walks to it over a cache; `sample_queries_sequentially` is the paper's
loop, kept as the reference.

The gradient is causal too. With q a leaf of the graph, ∂L/∂q_t flows on through the straight-through estimator into
q̃_t, hence into h_{t-1} and earlier queries. `backward` sweeps that adjoint backwards: after p sweeps, paths through
at most p queries are complete; enough sweeps give the sequential loop's gradient exactly (a test).

This module knows nothing about data or optimisers. Shape letters as in `training.models`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from training.models import BudgetedDecisionTransformer
from training.objectives import straight_through

__all__ = [
    "Rollout",
    "backward",
    "rollout",
    "sample_queries",
    "sample_queries_incrementally",
    "sample_queries_sequentially",
]


@dataclass(frozen=True)
class Rollout:
    """One pass over a batch of sequences with given queries."""

    query_BTM: Tensor  # a leaf: gradients gather here
    probs_BTM: Tensor
    hidden_BTW: Tensor


def rollout(model: BudgetedDecisionTransformer, context: Tensor, costly: Tensor, query: Tensor) -> Rollout:
    """Trunk and query probabilities for fixed queries: context [B, T, *], costly [B, T, D], query [B, T, M]."""
    hidden = model.trunk(model.tokens(context, costly, query))
    return Rollout(query, model.query_probs(model.shift(hidden), context), hidden)


@torch.no_grad()
def sample_queries(
    model: BudgetedDecisionTransformer, context: Tensor, costly: Tensor, uniforms_BTM: Tensor
) -> tuple[Tensor, int]:
    """The queries that the sequential loop samples with the same noise, [B, T, M], and how many passes it took."""
    length = uniforms_BTM.shape[1]
    if model.config.acquisition != "learned":
        return torch.full_like(uniforms_BTM, float(model.config.acquisition == "all")), 0
    query = (uniforms_BTM < 0.5).to(uniforms_BTM.dtype)
    open_B = torch.arange(len(query))  # sequences that are not at their fixed point yet
    for passes in range(1, length + 1):
        probs = rollout(model, context[open_B], costly[open_B], query[open_B]).probs_BTM
        sampled = (uniforms_BTM[open_B] < probs).to(query.dtype)
        changed_B = (sampled != query[open_B]).flatten(1).any(1)
        query[open_B] = sampled
        open_B = open_B[changed_B]
        if len(open_B) == 0:
            return query, passes
    return query, length


@torch.no_grad()
def sample_queries_incrementally(
    model: BudgetedDecisionTransformer, context: Tensor, costly: Tensor, uniforms_BTM: Tensor
) -> tuple[Tensor, int]:
    """The same queries, one timestep after another over cached keys and values: each token is computed once.

    Cheaper than parallel passes where a small batch keeps the processor busy (a CPU); the other way round on a GPU.
    """
    config, (batch, length, _) = model.config, uniforms_BTM.shape
    if config.acquisition != "learned":
        return torch.full_like(uniforms_BTM, float(config.acquisition == "all")), 0
    shape = (config.n_layers, batch, config.n_heads, length, config.width // config.n_heads)
    keys, values = context.new_empty(shape), context.new_empty(shape)
    hidden, query = context.new_zeros(batch, config.width), torch.empty_like(uniforms_BTM)
    for t in range(length):
        probs = model.query_probs(hidden, context[:, t])
        query[:, t] = uniforms_BTM[:, t] < probs
        x = model.tokens(context[:, t], costly[:, t], query[:, t])
        span = slice(max(0, t - config.context_length + 1), t)
        ages = torch.arange(span.stop - span.start, 0, -1)[None]
        for layer, block in enumerate(model.blocks):
            x, key, value = block.step(x, keys[layer, :, :, span], values[layer, :, :, span], ages)
            keys[layer, :, :, t], values[layer, :, :, t] = key, value
        hidden = model.norm_out(x)
    return query, length


def sample_queries_sequentially(
    model: BudgetedDecisionTransformer, context: Tensor, costly: Tensor, uniforms_BTM: Tensor
) -> Rollout:
    """The paper's loop: one timestep after another, the whole history recomputed at each. Differentiable throughout."""
    batch, length, _ = uniforms_BTM.shape
    hidden = context.new_zeros(batch, 1, model.config.width)
    tokens: list[Tensor] = []
    queries, probs_all, hiddens = [], [], []
    for t in range(length):
        now = slice(t, t + 1)
        probs = model.query_probs(hidden, context[:, now])
        query = straight_through((uniforms_BTM[:, now] < probs).to(probs.dtype), probs)
        tokens.append(model.tokens(context[:, now], costly[:, now], query))
        hidden = model.trunk(torch.cat(tokens, dim=1))[:, -1:]
        queries.append(query)
        probs_all.append(probs)
        hiddens.append(hidden)
    return Rollout(torch.cat(queries, 1), torch.cat(probs_all, 1), torch.cat(hiddens, 1))


def backward(sampled: Rollout, loss: Callable[[Rollout], Tensor], sweeps: int) -> Tensor:
    """Accumulate parameter gradients of `loss` with straight-through queries; return the loss, detached.

    `sampled.query_BTM` must be a leaf that requires a gradient. Each sweep but the last only moves the adjoint of the
    queries one query further into the past; the last one also reaches the parameters.
    """
    value = loss(sampled)
    query, probs = sampled.query_BTM, sampled.probs_BTM
    if not probs.requires_grad:
        value.backward()
        return value.detach()
    (direct,) = torch.autograd.grad(value, query, retain_graph=True)
    adjoint = direct
    for _ in range(sweeps - 1):
        (through,) = torch.autograd.grad(probs, query, grad_outputs=adjoint, retain_graph=True)
        adjoint = direct + through
    torch.autograd.backward([value, probs], [torch.ones_like(value), adjoint])
    return value.detach()
