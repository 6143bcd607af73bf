"""What a network is told of all traces at once: how large their numbers are, how much they earn. One pass.

This module knows nothing about files or networks.
"""

from __future__ import annotations

from array import array
from typing import NamedTuple

import msgspec
import numpy as np
import torch
from torch import Tensor

from training.steps import Steps

__all__ = ["Moments", "Spread", "Statistics", "Tally"]


class Spread(NamedTuple):
    """Mean and scale of each number: what normalisation takes off, and divides by."""

    mean: tuple[float, ...]
    scale: tuple[float, ...]


class Statistics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of every timestep, those included that are held out. Raises ValueError."""

    n_episodes: int
    n_steps: int
    free: Spread
    costly: Spread
    returns_to_go: Spread
    return_90: float  # 90th percentile of the episodes' returns

    def __post_init__(self) -> None:
        if not 1 <= self.n_episodes <= self.n_steps:
            raise ValueError(f"{self.n_episodes} episodes and {self.n_steps} timesteps, expected 1 or more of each")
        for name in ("free", "costly", "returns_to_go"):
            mean, scale = getattr(self, name)
            if len(mean) != len(scale) or not np.isfinite([*mean, *scale]).all() or min(scale, default=1.0) <= 0.0:
                raise ValueError(f"statistics of {name}: expected as many scales above 0 as means, all finite")
        if not np.isfinite(self.return_90):
            raise ValueError(f"return_90 is {self.return_90}, expected a finite number")


class Moments:
    """Mean and deviation of numbers that come in parts (Chan, Golub and LeVeque's update), in float64."""

    def __init__(self) -> None:
        self._count = 0
        self._mean = self._squares = torch.zeros((), dtype=torch.float64)
        self._low = self._high = torch.empty(())

    def add(self, x_TD: Tensor) -> None:
        """Count one or more rows."""
        x_TD = x_TD.double()
        n, mean = len(x_TD), x_TD.mean(0)
        gap = mean - self._mean
        self._low = x_TD.amin(0) if not self._count else torch.minimum(self._low, x_TD.amin(0))
        self._high = x_TD.amax(0) if not self._count else torch.maximum(self._high, x_TD.amax(0))
        total = self._count + n
        self._mean = self._mean + gap * (n / total)
        self._squares = self._squares + (x_TD - mean).square().sum(0) + gap.square() * (self._count * n / total)
        self._count = total

    def spread(self) -> Spread:
        """The scale is the standard deviation, with a floor at a tenth of the largest deviation: a class seen once in a
        thousand steps must not enter the network thirty times too large."""
        deviation = (self._squares / self._count).sqrt()
        largest = torch.maximum(self._high - self._mean, self._mean - self._low)
        scale = torch.maximum(deviation, 0.1 * largest)
        scale = torch.where(scale > 1e-6, scale, 1.0)  # what never varied may do so at play
        return Spread(*(tuple(part.float().tolist()) for part in (self._mean, scale)))


class Tally:
    """Statistics of episodes that come one at a time. Their returns are kept: 4 bytes an episode."""

    def __init__(self) -> None:
        self._free, self._costly, self._returns_to_go = Moments(), Moments(), Moments()
        self._returns = array("f")
        self._n_steps = 0

    def add(self, episode: Steps) -> None:
        """Count an episode."""
        self._free.add(episode.free_TF)
        self._costly.add(episode.costly_TD)
        self._returns_to_go.add(episode.returns_to_go_T[:, None])
        self._returns.append(float(episode.returns_to_go_T[0]))
        self._n_steps += len(episode.returns_to_go_T)

    def statistics(self) -> Statistics:
        """Of at least one episode."""
        return Statistics(
            n_episodes=len(self._returns),
            n_steps=self._n_steps,
            free=self._free.spread(),
            costly=self._costly.spread(),
            returns_to_go=self._returns_to_go.spread(),
            return_90=float(np.percentile(self._returns, 90)),
        )
