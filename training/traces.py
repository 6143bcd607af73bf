"""Recorded traces: reading a Minari dataset, returns-to-go, normalisation, and windows of timesteps.

This module knows nothing about networks or games: what a trace holds is told by the feature table and the action
layout that stand in the dataset's own metadata. Shape letters: E episodes, S steps of all episodes, and those of
`protocol.features`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import minari
import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track
from torch import Tensor

from protocol.features import ActionSpec, FeatureTable

__all__ = ["Batch", "Traces", "TracesError", "draw_windows", "load_traces", "moments", "returns_to_go"]


class TracesError(ValueError):
    """A dataset that cannot be trained on: what is wrong and where."""


@dataclass(frozen=True)
class Traces:
    """Episodes of a dataset, one after another."""

    features: FeatureTable
    action: ActionSpec
    free_SF: Tensor  # float32, raw units
    costly_SD: Tensor  # float16, raw units: half the memory, and rays carry no more precision than that
    actions_SA: Tensor  # float32
    returns_to_go_S: Tensor  # float32
    starts_E: NDArray[np.int64]  # first step of each episode
    lengths_E: NDArray[np.int64]

    @property
    def episode_returns_E(self) -> NDArray[np.float32]:
        """Return of each episode, shape [E]."""
        return self.returns_to_go_S.numpy()[self.starts_E]

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
    valid_BT: Tensor


def returns_to_go(rewards_T: NDArray[np.floating]) -> NDArray[np.float32]:
    """R_t = r_t + r_{t+1} + ... + r_{T-1}, shape [T]."""
    return rewards_T[::-1].cumsum(dtype=np.float64)[::-1].astype(np.float32)


def load_traces(path: Path, *, episodes: int | None = None) -> Traces:
    """Read a Minari dataset whose observations are {"free": [T+1, F], "costly": [T+1, D]}.

    Raises TracesError when the folder is no such dataset, holds HDF5 links out of itself, or does not match the feature
    table in its metadata.
    """
    if not (path / "data").is_dir():
        raise TracesError(f"{path} is not a Minari dataset: it has no folder 'data'")
    _refuse_links(path / "data")
    dataset = minari.MinariDataset(path / "data")
    metadata = dataset.storage.metadata
    try:
        features = msgspec.json.decode(_text(metadata["features"]), type=FeatureTable)
        action = msgspec.json.decode(_text(metadata["action"]), type=ActionSpec)
    except (KeyError, msgspec.ValidationError) as error:
        raise TracesError(f"{path}: metadata must hold 'features' and 'action': {error}") from error
    total = min(dataset.total_episodes, episodes or dataset.total_episodes)
    free, costly, actions, togo, lengths = [], [], [], [], []
    for i in track(range(total), description=f"reading {path.name}"):
        episode = dataset[i]
        n = len(episode.rewards)
        _check_width(path, i, "free", episode.observations["free"], features.n_free)
        _check_width(path, i, "costly", episode.observations["costly"], features.n_costly)
        _check_width(path, i, "actions", episode.actions, action.size)
        free.append(torch.from_numpy(episode.observations["free"][:n].astype(np.float32)))
        costly.append(torch.from_numpy(episode.observations["costly"][:n].astype(np.float16)))
        actions.append(torch.from_numpy(episode.actions.astype(np.float32)))
        togo.append(torch.from_numpy(returns_to_go(np.asarray(episode.rewards))))
        lengths.append(n)
    lengths_E = np.array(lengths, dtype=np.int64)
    starts_E = np.concatenate([[0], lengths_E.cumsum()[:-1]])
    return Traces(
        features, action, torch.cat(free), torch.cat(costly), torch.cat(actions), torch.cat(togo), starts_E, lengths_E
    )


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
    index_BT = torch.from_numpy(traces.starts_E[episode_B][:, None] + np.minimum(step_BT, length_B[:, None] - 1))
    return Batch(
        traces.free_SF[index_BT],
        traces.costly_SD[index_BT].float(),
        traces.actions_SA[index_BT],
        traces.returns_to_go_S[index_BT][..., None],
        torch.from_numpy(valid_BT.astype(np.float32)),
    )


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _check_width(path: Path, episode: int, name: str, array: NDArray[np.floating], expected: int) -> None:
    if array.ndim != 2 or array.shape[1] != expected:
        raise TracesError(f"{path}: episode {episode}: {name} has shape {array.shape}, expected [steps, {expected}]")
    if not np.isfinite(array).all():
        raise TracesError(f"{path}: episode {episode}: {name} has numbers that are not finite")


def _refuse_links(folder: Path) -> None:
    """An HDF5 file may point at other files; a dataset from outside must not (nor may its files be links)."""
    for file in folder.glob("*.hdf5"):
        if file.is_symlink():
            raise TracesError(f"{file} is a symbolic link, expected a regular file")
        with h5py.File(file) as root:
            groups = [root]
            while groups:
                group = groups.pop()
                for name in group:
                    link = group.get(name, getlink=True)
                    if not isinstance(link, h5py.HardLink):
                        raise TracesError(f"{file}: {group.name}/{name} is a {type(link).__name__}, expected data")
                    child = group[name]
                    if isinstance(child, h5py.Group):
                        groups.append(child)
                    elif child.external or child.is_virtual:
                        raise TracesError(f"{file}: {child.name} keeps its data in another file, expected it inside")
