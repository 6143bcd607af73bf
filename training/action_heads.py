"""The last layer of π̃: what the state says of the action, how well that fits a recorded one (Δ), and the action played.

Two kinds. Bins: each component is one of a few values. Gaussian: each component is a number with its own certainty, for
actions that are forces or angles: bins of a strong force lose it (docs/adr/0007). This module knows nothing about
queries, memory or files. Shape letters: W width of the state, A action components; `...` any leading axes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["ActionHead", "BinsHead", "GaussianHead", "nearest_bins"]

_LEAST_DEVIATION, _MOST_DEVIATION = -4.0, 1.0  # log of it, in half ranges of the action


class ActionHead(nn.Linear, ABC):
    """A linear layer on the state, and what it means."""

    low: Tensor
    high: Tensor

    def __init__(self, width: int, outputs: int, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        super().__init__(width, outputs)
        self.register_buffer("low", torch.tensor(low), persistent=False)
        self.register_buffer("high", torch.tensor(high), persistent=False)

    @abstractmethod
    def losses(self, hidden: Tensor, actions: Tensor) -> Tensor:
        """-log π̃(a | ...) of the recorded actions [..., A], summed over their components, up to a constant: [...]."""

    @abstractmethod
    def actions(self, hidden: Tensor, noise: Tensor) -> Tensor:
        """Raw action numbers [..., A]; `noise` [..., A] uniform in [0, 1) drives the components that are sampled."""


class BinsHead(ActionHead):
    """A categorical distribution over evenly spaced values of each component."""

    def __init__(
        self,
        width: int,
        bins: tuple[int, ...],
        low: tuple[float, ...],
        high: tuple[float, ...],
        sampled: tuple[bool, ...],
    ) -> None:
        """`sampled`: whether a component is drawn from its bins; otherwise the most probable one is taken."""
        super().__init__(width, sum(bins), low, high)
        self.bins, self.sampled = bins, sampled

    def logits(self, hidden: Tensor) -> list[Tensor]:
        """Logits over the bins of each action component: A tensors [..., bins]."""
        return list(self(hidden).split(self.bins, dim=-1))

    def losses(self, hidden: Tensor, actions: Tensor) -> Tensor:
        chosen = nearest_bins(actions, self.low, self.high, self.bins)
        parts = [
            functional.cross_entropy(logits.flatten(0, -2), chosen[..., i].flatten(), reduction="none")
            for i, logits in enumerate(self.logits(hidden))
        ]
        return torch.stack(parts).sum(0).view(actions.shape[:-1])

    def actions(self, hidden: Tensor, noise: Tensor) -> Tensor:
        chosen = []
        for i, logits in enumerate(self.logits(hidden)):
            if self.sampled[i]:
                cumulative = torch.softmax(logits, dim=-1).cumsum(-1)
                bin_ = (noise[..., i : i + 1] >= cumulative[..., :-1]).to(logits.dtype).sum(-1)
            else:
                bin_ = logits.argmax(-1).to(logits.dtype)
            chosen.append(bin_ / (self.bins[i] - 1))
        return self.low + torch.stack(chosen, dim=-1) * (self.high - self.low)


class GaussianHead(ActionHead):
    """A normal distribution of each component, its mean within the component's range. The action is the mean."""

    def __init__(self, width: int, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        super().__init__(width, 2 * len(low), low, high)

    def losses(self, hidden: Tensor, actions: Tensor) -> Tensor:
        mean, deviation = self(hidden).chunk(2, dim=-1)
        deviation = deviation.clamp(_LEAST_DEVIATION, _MOST_DEVIATION)
        # In half ranges, so that Δ weighs radians and newtons alike.
        wanted = 2.0 * (actions - self.low) / (self.high - self.low) - 1.0
        gap = (wanted - torch.tanh(mean)) / deviation.exp()
        return (0.5 * gap.square() + deviation).sum(-1)

    def actions(self, hidden: Tensor, noise: Tensor) -> Tensor:
        mean, _ = self(hidden).chunk(2, dim=-1)
        return self.low + 0.5 * (torch.tanh(mean) + 1.0) * (self.high - self.low)


def nearest_bins(actions: Tensor, low: Tensor, high: Tensor, bins: tuple[int, ...]) -> Tensor:
    """Index of the bin nearest to each action number, [..., A] long."""
    steps = actions.new_tensor(bins) - 1
    scaled = (torch.minimum(torch.maximum(actions, low), high) - low) / (high - low) * steps
    return scaled.round().long()
