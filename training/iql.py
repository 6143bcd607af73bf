"""Implicit Q-learning's critics (Kostrikov et al., *Offline Reinforcement Learning with Implicit Q-Learning*, 2021).

Value and Q read every feature: only the policy is used at run time, so only the policy's features are masked (the
paper's footnote on its baselines). What leaves is a weight for each timestep of the action loss. This module knows
nothing about policies, queries or costs. Shape letters: B batch, T time, X numbers of a state, A action components.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["Critics", "taught"]

_WIDTH = 256
_EXPECTILE = 0.7  # τ of the locomotion tasks
_TEMPERATURE = 3.0  # β of the locomotion tasks, on rewards scaled as below
_DISCOUNT = 0.99
_POLYAK = 0.05  # how fast the target Q follows: ten times the authors', for runs of thousands of updates, not a million
_MOST_WEIGHT = 100.0


def taught(last_BT: Tensor, valid_BT: Tensor) -> Tensor:
    """Timesteps that teach Q something: a window's last one has no successor in it, and counts for V alone, unless its
    episode ends there. [B, T]"""
    taught_BT = valid_BT.clone()
    taught_BT[:, -1] *= last_BT[:, -1]
    return taught_BT


def _perceptron(inputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, 1)
    )


class Critics(nn.Module):
    """V(s), two Q(s, a) and their slow copies."""

    def __init__(self, state: int, action: int, reward_scale: float) -> None:
        """`state` and `action`: how many numbers; `reward_scale`: what rewards are divided by."""
        super().__init__()
        self.reward_scale = reward_scale
        self.value = _perceptron(state)
        self.q = nn.ModuleList(_perceptron(state + action) for _ in range(2))
        self.target_q = copy.deepcopy(self.q).requires_grad_(False)

    def weights(self, state_BTX: Tensor, action_BTA: Tensor) -> Tensor:
        """exp(β (Q - V)), at most 100: how much each timestep's action is worth imitating (Eq. 7 there), [B, T]."""
        with torch.no_grad():
            advantage = self._target(state_BTX, action_BTA) - self.value(state_BTX)[..., 0]
            return torch.exp(_TEMPERATURE * advantage).clamp(max=_MOST_WEIGHT)

    def forward(
        self, state_BTX: Tensor, action_BTA: Tensor, returns_to_go_BT: Tensor, last_BT: Tensor, valid_BT: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Expectile loss of V (Eq. 5 there), a mean over `valid`; squared TD error of both Q (Eq. 6 there), a mean over
        `taught`. Scalars, to be minimised together.

        The reward of a timestep is what its return-to-go loses until the next one; an episode's last timestep keeps it
        all.
        """
        value_BT = self.value(state_BTX)[..., 0]
        gap = self._target(state_BTX, action_BTA) - value_BT
        expectile = torch.where(gap > 0, _EXPECTILE, 1.0 - _EXPECTILE) * gap.square()
        value_loss = (expectile * valid_BT).sum() / valid_BT.sum()
        next_togo = functional.pad(returns_to_go_BT[:, 1:], (0, 1)) * (1.0 - last_BT)
        next_value = functional.pad(value_BT[:, 1:], (0, 1)) * (1.0 - last_BT)
        goal = (returns_to_go_BT - next_togo) / self.reward_scale + _DISCOUNT * next_value.detach()
        taught_BT = taught(last_BT, valid_BT)
        both = torch.cat([state_BTX, action_BTA], dim=-1)
        errors_BT = sum((q(both)[..., 0] - goal).square() for q in self.q)
        return value_loss, (errors_BT * taught_BT).sum() / taught_BT.sum().clamp(min=1.0)

    @torch.no_grad()
    def follow(self) -> None:
        """Move the slow copies a little towards the two Q."""
        for slow, fast in zip(self.target_q.parameters(), self.q.parameters(), strict=True):
            slow.lerp_(fast, _POLYAK)

    def _target(self, state_BTX: Tensor, action_BTA: Tensor) -> Tensor:
        both = torch.cat([state_BTX, action_BTA], dim=-1)
        with torch.no_grad():
            return torch.minimum(*(q(both)[..., 0] for q in self.target_q))
