"""Training that knows the cap: the runtime's own allocation, applied to what is sampled while learning.

This module knows nothing about networks: it makes the `Fit` that the samplers of `training.acquisition` take.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bot_runtime.budget import allocate
from training.acquisition import Fit

__all__ = ["fit_bots", "fit_frames"]


def fit_bots(costs_M: Tensor, target_B: Tensor) -> Fit:
    """Each query costs at most its own window's target cost, [B] shares of the full cost."""
    costs, budgets = (costs_M / costs_M.sum()).double().cpu().numpy(), target_B.double().cpu().numpy()

    def fit(probs_BM: Tensor, sampled_BM: Tensor) -> Tensor:
        query = allocate(probs_BM.cpu().numpy(), sampled_BM.bool().cpu().numpy(), costs, 0.0, budgets)
        return torch.from_numpy(query).to(sampled_BM)

    return fit


def fit_frames(costs_M: Tensor, target_B: Tensor, bots: int) -> Fit:
    """Every `bots` windows in a row are one frame's bots: together they spend at most the sum of their target costs."""
    costs, targets = (costs_M / costs_M.sum()).double().cpu().numpy(), target_B.double().cpu().numpy()

    def fit(probs_BM: Tensor, sampled_BM: Tensor) -> Tensor:
        probs, sampled = probs_BM.cpu().numpy(), sampled_BM.bool().cpu().numpy()
        frames = [
            allocate(probs[i : i + bots], sampled[i : i + bots], costs, 0.0, np.inf, targets[i : i + bots].sum())
            for i in range(0, len(probs), bots)
        ]
        return torch.from_numpy(np.concatenate(frames)).to(sampled_BM)

    return fit
