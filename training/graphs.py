"""The two graphs that a bundle serves: the split-off acquisition head, and one incremental step of the trunk.

Thin modules over the trained network's own parameters; raw numbers in and out. This module knows nothing about files.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from training.models import BudgetedDecisionTransformer

__all__ = ["AcquisitionGraph", "ActionGraph"]


class AcquisitionGraph(nn.Module):
    """hidden [N, W], free [N, F], returns_to_go [N, 1] -> query_probs [N, M]."""

    def __init__(self, model: BudgetedDecisionTransformer) -> None:
        super().__init__()
        self.model = model

    def forward(self, hidden: Tensor, free: Tensor, returns_to_go: Tensor) -> Tensor:
        return self.model.query_probs(hidden, self.model.context(free, returns_to_go))


class ActionGraph(nn.Module):
    """One turn for N bots: their features and caches -> actions, the trunk's state, and the new cache entries."""

    def __init__(self, model: BudgetedDecisionTransformer) -> None:
        super().__init__()
        self.model = model

    def forward(
        self,
        free: Tensor,  # [N, F]
        costly: Tensor,  # [N, D], anything finite where not acquired
        query: Tensor,  # [N, M], 0 or 1
        returns_to_go: Tensor,  # [N, 1]
        noise: Tensor,  # [N, A]
        keys: Tensor,  # [L, N, H, S, h]
        values: Tensor,  # [L, N, H, S, h]
        ages: Tensor,  # [N, S], 1 to K - 1, or K for an empty slot
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        model = self.model
        x = model.tokens(model.context(free, returns_to_go), costly, query)
        new_keys, new_values = [], []
        for layer, block in enumerate(model.blocks):
            x, key, value = block.step(x, keys[layer], values[layer], ages)
            new_keys.append(key)
            new_values.append(value)
        hidden = model.norm_out(x)
        return model.actions(hidden, noise), hidden, torch.stack(new_keys), torch.stack(new_values)
