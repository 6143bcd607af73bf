"""What is learned: the action loss Δ, the query and its straight-through gradient, its cost and the penalty φ.

This module knows nothing about networks, data or optimisers: pure functions on tensors. Shape letters as in
`training.policy`.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

__all__ = ["action_loss", "nearest_bins", "penalty", "query_cost", "straight_through"]


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


def nearest_bins(actions: Tensor, low: tuple[float, ...], high: tuple[float, ...], bins: tuple[int, ...]) -> Tensor:
    """Index of the bin nearest to each action number, [..., A] long."""
    low_A, high_A = actions.new_tensor(low), actions.new_tensor(high)
    steps = actions.new_tensor(bins) - 1
    scaled = (actions.clamp(low_A, high_A) - low_A) / (high_A - low_A) * steps
    return scaled.round().long()


def action_loss(logits: list[Tensor], bins_BTA: Tensor, valid_BT: Tensor, weight_BT: Tensor | None = None) -> Tensor:
    """Δ = -log π̃(a_t | ...), summed over action components, averaged over timesteps that are not padding. Scalar.
    `weight_BT` says how much each timestep's action is worth imitating (IQL's advantage weight; None: all the same)."""
    counted = (valid_BT if weight_BT is None else valid_BT * weight_BT).flatten()
    total = logits[0].new_zeros(())
    for i, logits_BTn in enumerate(logits):
        losses = functional.cross_entropy(logits_BTn.flatten(0, 1), bins_BTA[..., i].flatten(), reduction="none")
        total = total + (losses * counted).sum()
    return total / valid_BT.sum()
