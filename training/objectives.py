"""What is learned: the action loss Δ, the query and its straight-through gradient, its cost and the penalty φ.

This module knows nothing about networks, data or optimisers: pure functions on tensors. Shape letters as in
`training.policy`.
"""

from __future__ import annotations

from torch import Tensor

__all__ = ["action_loss", "penalty", "query_cost", "straight_through"]


def straight_through(query: Tensor, probs: Tensor) -> Tensor:
    """q = Bernoulli(q̃) + q̃ - detach(q̃): the sampled query in value, the probabilities in gradient."""
    return query + probs - probs.detach()


def query_cost(query: Tensor, costs: Tensor) -> Tensor:
    """c(q) = <q, f> / ‖f‖₁ in [0, 1] (Eq. 4): query [..., M], costs [M] -> [...]."""
    return query @ (costs / costs.sum())


def penalty(cost_BT: Tensor, budget: float | Tensor, valid_BT: Tensor, weight_BT: Tensor | None = None) -> Tensor:
    """φ = mean over timesteps of max(c(q_t) - C, 0) (Eq. 2); padding does not count. Scalar. `weight_BT` (γ where it
    differs from window to window, 0 on padding) makes it γφ."""
    excess = (cost_BT - budget).clamp(min=0.0) * (valid_BT if weight_BT is None else weight_BT)
    return excess.sum() / valid_BT.sum()


def action_loss(losses_BT: Tensor, valid_BT: Tensor) -> Tensor:
    """Δ: the mean over timesteps that are not padding of -log π̃(a_t | ...), or of as much of it as an action is worth
    imitating. Scalar."""
    return (losses_BT * valid_BT).sum() / valid_BT.sum()
