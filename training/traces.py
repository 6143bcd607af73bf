"""Recorded traces: returns-to-go, normalisation, and windows of timesteps.

This module knows nothing about networks or games: what a trace holds is told by the feature table and the action
layout that stand in the dataset's own metadata. Shape letters: E episodes, S steps of all episodes, and those of
`protocol.features`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from protocol.features import ActionSpec, FeatureTable
from training.datasets import Dataset, TracesError, open_dataset
from training.feature_map import FeatureMap

__all__ = ["Batch", "Traces", "TracesError", "draw_windows", "load_traces", "moments", "returns_to_go"]

_HALF_FROM = 256  # costly numbers: from here on half the memory matters, and rays carry no more precision than that


@dataclass(frozen=True)
class Traces:
    """Episodes of a dataset, one after another."""

    features: FeatureTable
    action: ActionSpec
    free_SF: Tensor  # float32, raw units
    costly_SD: Tensor  # float32, raw units; float16 where they are many
    actions_SA: Tensor  # float32
    returns_to_go_S: Tensor  # float32
    starts_E: NDArray[np.int64]  # first step of each episode
    lengths_E: NDArray[np.int64]
    choices: int | None = None  # of a discrete action; None: the action is numbers

    @property
    def episode_returns_E(self) -> NDArray[np.float32]:
        """Return of each episode, shape [E]."""
        return self.returns_to_go_S.numpy()[self.starts_E]

    def to(self, device: str) -> Traces:
        """The same traces with their numbers on `device`."""
        names = ("free_SF", "costly_SD", "actions_SA", "returns_to_go_S")
        return replace(self, **{name: getattr(self, name).to(device) for name in names})

    def split(self, share: float) -> tuple[Traces, Traces]:
        """All but the last `share` of the episodes, and those: what is trained on, and what is held out."""
        first = len(self.lengths_E) - round(share * len(self.lengths_E))
        kept, rest = slice(0, first), slice(first, None)
        return tuple(
            replace(self, starts_E=self.starts_E[part], lengths_E=self.lengths_E[part]) for part in (kept, rest)
        )


@dataclass(frozen=True)
class Batch:
    """A batch of windows; timesteps past an episode's end are padding (`valid` 0)."""

    free_BTF: Tensor
    costly_BTD: Tensor
    actions_BTA: Tensor
    returns_to_go_BT1: Tensor
    last_BT: Tensor  # 1 at an episode's last timestep
    valid_BT: Tensor


def returns_to_go(rewards_T: NDArray[np.floating]) -> NDArray[np.float32]:
    """R_t = r_t + r_{t+1} + ... + r_{T-1}, shape [T]."""
    return rewards_T[::-1].cumsum(dtype=np.float64)[::-1].astype(np.float32)


def load_traces(*paths: Path, episodes: int | None = None, feature_map: FeatureMap | None = None) -> Traces:
    """Read Minari datasets (training/datasets.py), an episode of each in turn; `episodes` of each, None: all.

    Raises TracesError when one is no such dataset, does not match its feature table, or differs from the others.
    """
    datasets = [open_dataset(path, feature_map) for path in paths]
    first = datasets[0]
    for dataset in datasets[1:]:
        if (dataset.features, dataset.action) != (first.features, first.action):
            raise TracesError(f"{dataset.path} and {first.path} have other features or other actions")
    wanted = sorted((i, part) for part, dataset in enumerate(datasets) for i in range(_count(dataset, episodes)))
    half = first.features.n_costly >= _HALF_FROM
    free, costly, actions, togo = [], [], [], []
    for i, part in track(wanted, description=f"reading {', '.join(dataset.path.name for dataset in datasets)}"):
        read, where = datasets[part].episode(i), f"{datasets[part].path}: episode {i}"
        n = len(read.rewards_T)
        free.append(_rows(where, "free", read.free_TF, (n, first.features.n_free), np.float32))
        kind = np.float16 if half else np.float32
        costly.append(_rows(where, "costly", read.costly_TD, (n, first.features.n_costly), kind))
        actions.append(_rows(where, "actions", read.actions_TA, (n, first.action.size), np.float32))
        rewards = _rows(where, "rewards", read.rewards_T, (n,), np.float64)
        togo.append(torch.from_numpy(returns_to_go(rewards.numpy())))
    lengths_E = np.array([len(part) for part in togo], dtype=np.int64)
    starts_E = np.concatenate([[0], lengths_E.cumsum()[:-1]])
    numbers = (torch.cat(part) for part in (free, costly, actions, togo))
    return Traces(first.features, first.action, *numbers, starts_E, lengths_E, first.choices)


def _count(dataset: Dataset, episodes: int | None) -> int:
    count = len(dataset) if episodes is None else min(len(dataset), episodes)
    if count < 1:
        raise TracesError(f"{dataset.path}: {count} of {len(dataset)} episodes to read, expected 1 or more")
    return count


def moments(x_SD: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and scale of each number, each shape [D]. The scale is the standard deviation, with a floor at a tenth of
    the largest deviation: a class seen once in a thousand steps must not enter the network thirty times too large."""
    mean = torch.zeros(x_SD.shape[1])
    square = torch.zeros(x_SD.shape[1])
    largest = torch.zeros(x_SD.shape[1])
    for part in x_SD.split(65536):
        mean += part.float().sum(0)
        square += part.float().square().sum(0)
    mean /= len(x_SD)
    deviation = (square / len(x_SD) - mean.square()).clamp(min=0).sqrt()
    for part in x_SD.split(65536):
        largest = torch.maximum(largest, (part.float() - mean).abs().amax(0))
    return mean, torch.maximum(deviation, 0.1 * largest).clamp(min=1e-6)


def draw_windows(traces: Traces, batch: int, length: int, generator: np.random.Generator) -> Batch:
    """A batch of windows [B, T]: an episode in proportion to its length, then a start that lets its first timesteps be
    seen as often as the others."""
    share = traces.lengths_E / traces.lengths_E.sum()
    episode_B = generator.choice(len(share), size=batch, p=share)
    length_B = traces.lengths_E[episode_B]
    start_B = generator.integers(-(length // 2), np.maximum(length_B - length // 2, 1))
    start_B = start_B.clip(0, np.maximum(length_B - length, 0))
    step_BT = start_B[:, None] + np.arange(length)
    valid_BT = step_BT < length_B[:, None]
    device = traces.free_SF.device
    index_BT = torch.from_numpy(traces.starts_E[episode_B][:, None] + np.minimum(step_BT, length_B[:, None] - 1))
    index_BT = index_BT.to(device)
    return Batch(
        traces.free_SF[index_BT],
        traces.costly_SD[index_BT].float(),
        traces.actions_SA[index_BT],
        traces.returns_to_go_S[index_BT][..., None],
        torch.from_numpy((step_BT == length_B[:, None] - 1).astype(np.float32)).to(device),
        torch.from_numpy(valid_BT.astype(np.float32)).to(device),
    )


def _rows(where: str, name: str, array: NDArray[np.floating], shape: tuple[int, ...], dtype: type) -> Tensor:
    """The array as it is kept; numbers that do not fit `dtype` are refused like any that are not finite."""
    if array.shape != shape:
        raise TracesError(f"{where}: {name} has shape {array.shape}, expected {shape}")
    with np.errstate(over="ignore"):
        kept = array.astype(dtype)
    if not np.isfinite(kept).all():
        raise TracesError(f"{where}: {name} has numbers that are not finite as {np.dtype(dtype)}")
    return torch.from_numpy(kept)
