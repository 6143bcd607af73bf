"""Traces in memory, and windows of timesteps from them.

This module knows nothing about networks or games: what a trace holds is told by the feature table and the action
layout that stand in the dataset's own metadata. Shape letters: E episodes, S steps of all episodes, B batch, and those
of `protocol.features`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from training.feature_map import FeatureMap
from training.statistics import Statistics, Tally
from training.steps import Layout, Recordings, Steps

__all__ = ["EXAMPLE_STEPS", "Batch", "Traces", "Windows", "choose_windows", "load_traces", "read_windows"]

EXAMPLE_STEPS = 128  # most timesteps of the example


@dataclass(frozen=True)
class Traces:
    """Episodes, one after another."""

    layout: Layout
    free_SF: Tensor  # as in Steps
    costly_SD: Tensor
    actions_SA: Tensor
    returns_to_go_S: Tensor
    starts_E: NDArray[np.int64]  # first step of each episode
    lengths_E: NDArray[np.int64]
    weights_S: Tensor | None = None  # how much each timestep's action counts; None: all the same

    def __len__(self) -> int:
        """How many episodes there are."""
        return len(self.lengths_E)

    @property
    def episode_returns_E(self) -> NDArray[np.float32]:
        """Return of each episode, shape [E]."""
        return self.returns_to_go_S.numpy()[self.starts_E]

    @cached_property
    def statistics(self) -> Statistics:
        """Of all episodes."""
        tally = Tally()
        for episode in range(len(self)):
            tally.add(self.episode(episode))
        return tally.statistics()

    @cached_property
    def example(self) -> Steps:
        """How the first of the longest episodes begins."""
        longest = int(np.minimum(self.lengths_E, EXAMPLE_STEPS).argmax())
        return self.episode(longest).part(slice(0, EXAMPLE_STEPS))

    def episode(self, number: int) -> Steps:
        """One episode."""
        first = int(self.starts_E[number])
        steps = Steps(self.free_SF, self.costly_SD, self.actions_SA, self.returns_to_go_S)
        return steps.part(slice(first, first + int(self.lengths_E[number])))

    def pool(self, update: int) -> Traces:
        """What windows are drawn from at an update: all."""
        return self

    def to(self, device: str) -> Traces:
        """The same traces with their numbers on `device`."""
        names = ["free_SF", "costly_SD", "actions_SA", "returns_to_go_S"]
        names += [] if self.weights_S is None else ["weights_S"]
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def split(self, share: float) -> tuple[Traces, Traces]:
        """All but the last `share` of the episodes, and those: what is trained on, and what is held out."""
        first = len(self) - round(share * len(self))
        kept, rest = slice(0, first), slice(first, None)
        return tuple(
            replace(self, starts_E=self.starts_E[part], lengths_E=self.lengths_E[part]) for part in (kept, rest)
        )


class Windows(NamedTuple):
    """Where windows are."""

    first_B: NDArray[np.int64]  # step at which the episode begins
    length_B: NDArray[np.int64]  # of the episode
    step_BT: NDArray[np.int64]  # of the episode, past its end as well

    def rows(self, rows: slice) -> Windows:
        """Some of them."""
        return Windows(*(part[rows] for part in self))

    @property
    def valid_BT(self) -> Tensor:
        """0 past an episode's end."""
        return torch.from_numpy((self.step_BT < self.length_B[:, None]).astype(np.float32))

    def counted_BT(self, burn_in: int) -> Tensor:
        """0 past an episode's end, and at the first `burn_in` timesteps of a window that starts within an episode."""
        burnt_T = np.arange(self.step_BT.shape[1]) < burn_in
        return self.valid_BT * torch.from_numpy(~(burnt_T & (self.step_BT[:, :1] > 0)))

    @property
    def last_BT(self) -> Tensor:
        """1 at an episode's last timestep."""
        return torch.from_numpy((self.step_BT == self.length_B[:, None] - 1).astype(np.float32))


@dataclass(frozen=True)
class Batch:
    """A batch of windows; timesteps past an episode's end are padding (`valid` 0)."""

    free_BTF: Tensor
    costly_BTD: Tensor
    actions_BTA: Tensor
    returns_to_go_BT1: Tensor
    last_BT: Tensor  # 1 at an episode's last timestep
    valid_BT: Tensor
    weight_BT: Tensor  # how much each action counts


def load_traces(*paths: Path, episodes: int | None = None, feature_map: FeatureMap | None = None) -> Traces:
    """Read Minari datasets (training/steps.py) into memory; `episodes` of each, None: all.

    Raises TracesError when one is no such dataset, does not match its feature table, or differs from the others.
    """
    recordings = Recordings(paths, episodes, feature_map)
    read = list(track(recordings, description=f"reading {recordings.names}"))
    lengths_E = np.array([len(steps.returns_to_go_T) for steps in read], dtype=np.int64)
    starts_E = np.concatenate([[0], lengths_E.cumsum()[:-1]])
    return Traces(recordings.layout, *Steps.joined(read), starts_E, lengths_E)


def choose_windows(
    traces: Traces, batch: int, length: int, generator: np.random.Generator, beginnings: float = 0.0
) -> Windows:
    """Windows [B, T]: an episode in proportion to its length, then a start that may be cut by either end, but for the
    share `beginnings` of the windows, which start where their episode does.

    The first and last timesteps are seen half as often as those in the middle, those a window away half as often again;
    without the starts that are cut the first would be met once an episode."""
    share = traces.lengths_E / traces.lengths_E.sum()
    episode_B = generator.choice(len(share), size=batch, p=share)
    length_B = traces.lengths_E[episode_B]
    start_B = generator.integers(-(length // 2), np.maximum(length_B - length // 2, 1))
    start_B = start_B.clip(0, np.maximum(length_B - length, 0))
    if beginnings:
        start_B[generator.random(batch) < beginnings] = 0
    return Windows(traces.starts_E[episode_B], length_B, start_B[:, None] + np.arange(length))


def read_windows(traces: Traces, windows: Windows) -> Batch:
    """The numbers of windows."""
    device = traces.free_SF.device
    index_BT = windows.first_B[:, None] + np.minimum(windows.step_BT, windows.length_B[:, None] - 1)
    index_BT = torch.from_numpy(index_BT).to(device)
    valid_BT = windows.valid_BT.to(device)
    return Batch(
        traces.free_SF[index_BT],
        traces.costly_SD[index_BT].float(),
        traces.actions_SA[index_BT],
        traces.returns_to_go_S[index_BT][..., None],
        windows.last_BT.to(device),
        valid_BT,
        torch.ones_like(valid_BT) if traces.weights_S is None else traces.weights_S[index_BT],
    )
