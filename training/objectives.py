"""What is learned: the action loss Δ, the query and its straight-through gradient, the penalty φ and its weight γ.

This module knows nothing about networks, data or optimisers: pure functions on tensors. Shape letters as in
`training.models`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["action_loss", "nearest_bins", "penalty", "penalty_weight", "query_cost", "straight_through"]


def straight_through(query: Tensor, probs: Tensor) -> Tensor:
    """q = Bernoulli(q̃) + q̃ - detach(q̃): the sampled query in value, the probabilities in gradient."""
    return query + probs - probs.detach()


def query_cost(query: Tensor, costs: Tensor) -> Tensor:
    """c(q) = <q, f> / ‖f‖₁ in [0, 1] (Eq. 4): query [..., M], costs [M] -> [...]."""
    return query @ (costs / costs.sum())


def penalty(cost_BT: Tensor, budget: float, valid_BT: Tensor) -> Tensor:
    """φ = mean over timesteps of max(c(q_t) - C, 0) (Eq. 2); padding does not count. Scalar."""
    excess = (cost_BT - budget).clamp(min=0.0) * valid_BT
    return excess.sum() / valid_BT.sum()


def penalty_weight(weight: float, phi: float, step: float) -> float:
    """γ after a batch (Alg. 1, last lines): rises by ε only where the constraint was violated, never falls."""
    return weight + step if phi > 0.0 else weight


def nearest_bins(actions: Tensor, low: tuple[float, ...], high: tuple[float, ...], bins: tuple[int, ...]) -> Tensor:
    """Index of the bin nearest to each action number, [..., A] long."""
    low_A, high_A = torch.tensor(low), torch.tensor(high)
    steps = torch.tensor(bins) - 1
    scaled = (actions.clamp(low_A, high_A) - low_A) / (high_A - low_A) * steps
    return scaled.round().long()


def action_loss(logits: list[Tensor], bins_BTA: Tensor, valid_BT: Tensor) -> Tensor:
    """Δ = -log π̃(a_t | ...), summed over action components, averaged over timesteps that are not padding. Scalar."""
    total = torch.zeros((), dtype=logits[0].dtype)
    for i, logits_BTn in enumerate(logits):
        losses = functional.cross_entropy(logits_BTn.flatten(0, 1), bins_BTA[..., i].flatten(), reduction="none")
        total = total + (losses * valid_BT.flatten()).sum()
    return total / valid_BT.sum()
