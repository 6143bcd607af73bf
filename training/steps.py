"""Timesteps of recorded episodes as they are trained on: checked numbers, returns-to-go, an episode at a time.

This module knows nothing about batches or networks. Shape letters: T timesteps, and those of `protocol.features`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from protocol.features import ActionSpec, Feature, FeatureTable
from protocol.messages import MAX_RETURN
from training.datasets import Dataset, TracesError, open_dataset
from training.feature_map import FeatureMap

__all__ = ["Layout", "Recordings", "Steps", "costly_type", "returns_to_go"]

_HALF_FROM = 256  # costly numbers: from here on half the memory matters, and rays carry no more precision than that


@dataclass(frozen=True)
class Layout:
    """What the numbers of a timestep are."""

    features: FeatureTable
    action: ActionSpec
    choices: int | None = None  # of a discrete action; None: the action is numbers
    feature_map: FeatureMap | None = None  # None: the dataset itself tells free from costly


class Steps(NamedTuple):
    """T timesteps: an episode, or several one after another."""

    free_TF: Tensor  # float32, raw units
    costly_TD: Tensor  # float32, raw units; float16 where they are many
    actions_TA: Tensor  # float32
    returns_to_go_T: Tensor  # float32

    @classmethod
    def joined(cls, parts: Sequence[Steps]) -> Steps:
        """One after another."""
        return cls(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))

    def part(self, steps: slice) -> Steps:
        """Some of the timesteps."""
        return Steps(*(tensor[steps] for tensor in self))


def costly_type(features: FeatureTable) -> type[np.floating]:
    """How costly numbers are kept."""
    return np.float16 if features.n_costly >= _HALF_FROM else np.float32


def returns_to_go(rewards_T: NDArray[np.floating]) -> NDArray[np.float32]:
    """R_t = r_t + r_{t+1} + ... + r_{T-1}, shape [T]."""
    return rewards_T[::-1].cumsum(dtype=np.float64)[::-1].astype(np.float32)


class Recordings:
    """The episodes of Minari datasets (training/datasets.py), an episode of each in turn. Iterating reads them."""

    def __init__(
        self, paths: Sequence[Path], episodes: int | None = None, feature_map: FeatureMap | None = None
    ) -> None:
        """`episodes` of each dataset, None: all. Raises TracesError when one is no such dataset or differs from the
        others."""
        self._datasets = [open_dataset(path, feature_map) for path in paths]
        first = self._datasets[0]
        for dataset in self._datasets[1:]:
            if (dataset.features, dataset.action) != (first.features, first.action):
                raise TracesError(f"{dataset.path} and {first.path} have other features or other actions")
        self._counts = [_count(dataset, episodes) for dataset in self._datasets]
        self.layout = Layout(first.features, first.action, first.choices, feature_map)
        self.names = ", ".join(dataset.path.name for dataset in self._datasets)

    def __len__(self) -> int:
        """How many episodes there are."""
        return sum(self._counts)

    def __iter__(self) -> Iterator[Steps]:
        """Raises TracesError for an episode that does not match the feature table."""
        for i in range(max(self._counts)):
            for dataset, count in zip(self._datasets, self._counts, strict=True):
                if i < count:
                    yield _read(dataset, i)


def _count(dataset: Dataset, episodes: int | None) -> int:
    count = len(dataset) if episodes is None else min(len(dataset), episodes)
    if count < 1:
        raise TracesError(f"{dataset.path}: {count} of {len(dataset)} episodes to read, expected 1 or more")
    return count


def _read(dataset: Dataset, i: int) -> Steps:
    read, where = dataset.episode(i), f"{dataset.path}: episode {i}"
    n, features = len(read.rewards_T), dataset.features
    if not n:
        raise TracesError(f"{where} has no timesteps, expected 1 or more")
    rewards = _rows(where, "rewards", read.rewards_T, (n,), np.float64)
    togo_T = returns_to_go(rewards.numpy())
    if not np.abs(togo_T).max() <= MAX_RETURN:
        raise TracesError(f"{where}: its return is {togo_T[0]:g}, expected at most {MAX_RETURN:g} either way")
    steps = Steps(
        _rows(where, "free", read.free_TF, (n, features.n_free), np.float32),
        _rows(where, "costly", read.costly_TD, (n, features.n_costly), costly_type(features)),
        _rows(where, "actions", read.actions_TA, (n, dataset.action.size), np.float32),
        torch.from_numpy(togo_T),
    )
    _check_range(where, features.free, read.free_TF, features.free_range)
    _check_range(where, features.costly, read.costly_TD, features.costly_range)
    return steps


def _check_range(
    where: str, parts: Sequence[Feature], values_TX: NDArray[np.floating], limits: tuple[NDArray[np.float32], ...]
) -> None:
    """What a server would refuse a bot teaches none."""
    as_sent_TX = values_TX.astype(np.float32)
    outside_TX = (as_sent_TX < limits[0]) | (as_sent_TX > limits[1])
    if not outside_TX.any():
        return
    t, x = (int(index) for index in np.argwhere(outside_TX)[0])
    part = parts[int(np.repeat(np.arange(len(parts)), [one.size for one in parts])[x])]
    raise TracesError(
        f"{where}: {part.name} is {values_TX[t, x]:g} at timestep {t}, expected {part.low:g} to {part.high:g}, "
        "its low and high in the feature map: a server refuses a bot's numbers outside"
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
