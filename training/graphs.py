"""The two graphs that a bundle serves: the split-off acquisition head, and one step of the action policy.

Thin modules over the trained network's own parameters; raw numbers in and out. A network without memory has no hidden
state and no cache: those ports are left out. This module knows nothing about files.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from training.mlp import BudgetedPerceptron
from training.models import BudgetedDecisionTransformer
from training.policy import BudgetedPolicy

__all__ = ["AcquisitionGraph", "ActionGraph", "FrameActionGraph", "example_inputs"]


class AcquisitionGraph(nn.Module):
    """hidden [N, W] (with memory), free [N, F], returns_to_go [N, 1], target_cost [N, 1] (where C is an input)
    -> query_probs [N, M]."""

    def __init__(self, model: BudgetedPolicy) -> None:
        super().__init__()
        self.model = model

    def forward(
        self, free: Tensor, returns_to_go: Tensor, hidden: Tensor | None = None, target_cost: Tensor | None = None
    ) -> Tensor:
        if target_cost is None:
            target_cost = torch.full_like(returns_to_go, self.model.config.target_cost)
        memory = free[:, :0] if hidden is None else hidden
        return self.model.query_probs(memory, self.model.know(free, returns_to_go, target_cost))


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
        x = model.tokens(model.know(free, returns_to_go, torch.zeros_like(returns_to_go), costly), query)
        new_keys, new_values = [], []
        for layer, block in enumerate(model.blocks):
            x, key, value = block.step(x, keys[layer], values[layer], ages)
            new_keys.append(key)
            new_values.append(value)
        hidden = model.norm_out(x)
        return model.action_head.actions(hidden, noise), hidden, torch.stack(new_keys), torch.stack(new_values)


class FrameActionGraph(nn.Module):
    """One turn of N bots that remember nothing: their features -> actions [N, A]."""

    def __init__(self, model: BudgetedPerceptron) -> None:
        super().__init__()
        self.model = model

    def forward(self, free: Tensor, costly: Tensor, query: Tensor, returns_to_go: Tensor, noise: Tensor) -> Tensor:
        model = self.model
        known = model.know(free, returns_to_go, torch.zeros_like(returns_to_go), costly)
        return model.action_head.actions(model.hiddens(known, query), noise)


def example_inputs(model: BudgetedPolicy) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Inputs of both graphs by name, for two bots: what an exporter traces them with."""
    n, config = 2, model.config
    free, togo = torch.zeros(n, config.n_free), torch.zeros(n, 1)
    before, now = {"free": free, "returns_to_go": togo}, {"free": free}
    now |= {"costly": torch.zeros(n, len(config.owner)), "query": torch.zeros(n, config.n_queries)}
    now |= {"returns_to_go": togo, "noise": torch.zeros(n, config.n_actions)}
    if config.has_memory:
        slots = config.context_length - 1
        cache = torch.zeros(config.n_layers, n, config.n_heads, slots, config.width // config.n_heads)
        before["hidden"] = torch.zeros(n, config.width)
        now |= {"keys": cache, "values": cache.clone(), "ages": torch.full((n, slots), config.context_length)}
    if config.budget_conditioned:
        before["target_cost"] = torch.ones(n, 1)
    return before, now
