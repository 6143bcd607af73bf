"""Sampling queries along a sequence, and their gradients: exactly, without the paper's loop over timesteps.

q_t depends on h_{t-1}, which depends on the queries before t. With the uniform noise u fixed, q = [u < q̃(q)] has one
fixed point, because the system is causal: after p parallel passes the first p timesteps are final. `sample_queries`
iterates to it; `sample_queries_sequentially` is the paper's loop, kept as the reference.

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

__all__ = ["Rollout", "backward", "rollout", "sample_queries", "sample_queries_sequentially"]


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
    for passes in range(1, length + 1):
        probs = rollout(model, context, costly, query).probs_BTM
        sampled = (uniforms_BTM < probs).to(query.dtype)
        if torch.equal(sampled, query):
            return query, passes
        query = sampled
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
