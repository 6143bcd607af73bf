"""Sampling queries along a sequence, and their gradients: exactly, without recomputing the past at every timestep.

q_t depends on h_{t-1}, which depends on the queries before t. With the uniform noise u fixed, q = [u < q̃(q)] has one
fixed point, because the system is causal: after p parallel passes the first p timesteps are final. `sample_queries`
iterates to it; `sample_queries_incrementally` walks to it over a cache; `sample_queries_sequentially` is the paper's
loop, kept as the reference. A network without memory, or whose queries are not learned, is at it after one pass.

What was sampled may have to fit a budget before it is acquired: `Fit` is that step, the same in training as at run
time, and as causal as the sampling.

The gradient is causal too. With q a leaf of the graph, ∂L/∂q_t flows on through the straight-through estimator into
q̃_t, hence into h_{t-1} and earlier queries. `backward` sweeps that adjoint backwards: after p sweeps, paths through
at most p queries are complete; enough sweeps give the sequential loop's gradient exactly (a test).

This module knows nothing about data or optimisers. Shape letters as in `training.policy`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from training.models import BudgetedDecisionTransformer
from training.objectives import straight_through
from training.policy import BudgetedPolicy, Known

__all__ = [
    "Fit",
    "Rollout",
    "backward",
    "rollout",
    "sample_queries",
    "sample_queries_incrementally",
    "sample_queries_sequentially",
]

Fit = Callable[[Tensor, Tensor], Tensor]
"""(probs [B, M], sampled [B, M]) of one timestep -> the part of what was sampled that is acquired, [B, M]."""


@dataclass(frozen=True)
class Rollout:
    """One pass over a batch of sequences with given queries."""

    query_BTM: Tensor  # a leaf: gradients gather here
    probs_BTM: Tensor
    hidden_BTW: Tensor


def rollout(model: BudgetedPolicy, known: Known, query_BTM: Tensor) -> Rollout:
    """Hidden states and query probabilities for fixed queries."""
    hidden = model.hiddens(known, query_BTM)
    return Rollout(query_BTM, model.query_probs(model.memory(hidden), known), hidden)


def _draw(probs: Tensor, uniforms: Tensor, fit: Fit | None) -> Tensor:
    """The queries of timesteps whose probabilities are known, [B, T, M]."""
    sampled = (uniforms < probs).to(probs.dtype)
    if fit is None:
        return sampled
    return torch.stack([fit(probs[:, t], sampled[:, t]) for t in range(probs.shape[1])], dim=1)


@torch.no_grad()
def sample_queries(
    model: BudgetedPolicy, known: Known, uniforms_BTM: Tensor, fit: Fit | None = None
) -> tuple[Tensor, int]:
    """The queries that the sequential loop samples with the same noise, [B, T, M], and how many passes it took."""
    length = uniforms_BTM.shape[1]
    query = (uniforms_BTM < 0.5).to(uniforms_BTM.dtype)
    if model.config.acquisition != "learned" or not model.config.has_memory:
        no_memory = uniforms_BTM.new_zeros(*uniforms_BTM.shape[:2], model.memory_width)
        return _draw(model.query_probs(no_memory, known), uniforms_BTM, fit), 1
    open_B = torch.arange(len(query), device=query.device)  # sequences that are not at their fixed point yet
    for passes in range(1, length + 1):
        probs = rollout(model, known.rows(open_B), query[open_B]).probs_BTM
        sampled = _draw(probs, uniforms_BTM[open_B], fit)
        changed_B = (sampled != query[open_B]).flatten(1).any(1)
        query[open_B] = sampled
        if fit is None:  # with a shared budget the sequences depend on each other
            open_B = open_B[changed_B]
        if not changed_B.any():
            return query, passes
    return query, length


@torch.no_grad()
def sample_queries_incrementally(
    model: BudgetedPolicy, known: Known, uniforms_BTM: Tensor, fit: Fit | None = None
) -> tuple[Tensor, int]:
    """The same queries, one timestep after another over cached keys and values: each token is computed once.

    Cheaper than parallel passes where a small batch keeps the processor busy (a CPU); the other way round on a GPU.
    """
    if model.config.acquisition != "learned" or not isinstance(model, BudgetedDecisionTransformer):
        return sample_queries(model, known, uniforms_BTM, fit)
    config, (batch, length, _) = model.config, uniforms_BTM.shape
    heads, head = config.token
    shape = (config.n_layers, batch, heads, length, head)
    keys, values = uniforms_BTM.new_empty(shape), uniforms_BTM.new_empty(shape)
    hidden, query = uniforms_BTM.new_zeros(batch, config.width), torch.empty_like(uniforms_BTM)
    ages = torch.arange(length, 0, -1, device=query.device)[None]
    for t in range(length):
        now = known.at(t)
        probs = model.query_probs(hidden, now)
        sampled = (uniforms_BTM[:, t] < probs).to(query.dtype)
        query[:, t] = sampled if fit is None else fit(probs, sampled)
        x = model.tokens(now, query[:, t])
        span = slice(max(0, t - config.context_length + 1), t)
        for layer, block in enumerate(model.blocks):
            past = keys[layer, :, :, span], values[layer, :, :, span]
            x, key, value = block.step(x, *past, ages[:, length - t + span.start :])
            keys[layer, :, :, t], values[layer, :, :, t] = key, value
        hidden = model.norm_out(x)
    return query, length


def sample_queries_sequentially(
    model: BudgetedDecisionTransformer, known: Known, uniforms_BTM: Tensor, fit: Fit | None = None
) -> Rollout:
    """The paper's loop: one timestep after another, the whole history recomputed at each. Differentiable throughout."""
    batch, length, _ = uniforms_BTM.shape
    hidden = uniforms_BTM.new_zeros(batch, model.config.width)
    tokens: list[Tensor] = []
    queries, probs_all, hiddens = [], [], []
    for t in range(length):
        now = known.at(t)
        probs = model.query_probs(hidden, now)
        sampled = (uniforms_BTM[:, t] < probs).to(probs.dtype)
        query = straight_through(sampled if fit is None else fit(probs.detach(), sampled), probs)
        tokens.append(model.tokens(now, query))
        hidden = model.trunk(torch.stack(tokens, dim=1))[:, -1]
        queries.append(query)
        probs_all.append(probs)
        hiddens.append(hidden)
    return Rollout(torch.stack(queries, 1), torch.stack(probs_all, 1), torch.stack(hiddens, 1))


def backward(sampled: Rollout, loss: Tensor, sweeps: int, parameters: Sequence[nn.Parameter]) -> None:
    """Accumulate gradients of `parameters` of a scalar `loss` of `sampled` with straight-through queries.

    `sampled.query_BTM` must be a leaf that requires a gradient. Each sweep but the last only moves the adjoint of the
    queries one query further into the past; the last one reaches the parameters, and leaves the queries out.
    """
    query, probs = sampled.query_BTM, sampled.probs_BTM
    if not probs.requires_grad:
        loss.backward(inputs=parameters)
        return
    (direct,) = torch.autograd.grad(loss, query, retain_graph=True)
    adjoint = direct
    for _ in range(sweeps - 1):
        (through,) = torch.autograd.grad(probs, query, grad_outputs=adjoint, retain_graph=True)
        adjoint = direct + through
    torch.autograd.backward([loss, probs], [torch.ones_like(loss), adjoint], inputs=parameters)
