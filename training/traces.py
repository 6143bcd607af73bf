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


def load_traces(path: Path, *, episodes: int | None = None) -> Traces:
    """Read a Minari dataset whose observations are {"free": [T+1, F], "costly": [T+1, D]}; `episodes` None reads all.

    Raises TracesError when the folder is no such dataset, holds HDF5 links out of itself, or does not match the feature
    table in its metadata.
    """
    dataset, features, action = _open(path)
    total = dataset.total_episodes if episodes is None else min(dataset.total_episodes, episodes)
    if total < 1:
        raise TracesError(f"{path}: {total} of {dataset.total_episodes} episodes to read, expected 1 or more")
    free, costly, actions, togo, lengths = [], [], [], [], []
    for i in track(range(total), description=f"reading {path.name}"):
        episode, where = dataset[i], f"{path}: episode {i}"
        n = len(episode.rewards)
        free.append(_rows(where, "free", episode.observations["free"][:n], (n, features.n_free), np.float32))
        costly.append(_rows(where, "costly", episode.observations["costly"][:n], (n, features.n_costly), np.float16))
        actions.append(_rows(where, "actions", episode.actions, (n, action.size), np.float32))
        rewards = _rows(where, "rewards", np.asarray(episode.rewards), (n,), np.float64)
        togo.append(torch.from_numpy(returns_to_go(rewards.numpy())))
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


def _open(path: Path) -> tuple[minari.MinariDataset, FeatureTable, ActionSpec]:
    data = path / "data"
    if not (data / "metadata.json").is_file():
        raise TracesError(f"{path} is not a Minari dataset: it has no data/metadata.json")
    _refuse_links(data)
    try:
        metadata = json.loads((data / "metadata.json").read_bytes())
        features = msgspec.json.decode(_text(metadata["features"]), type=FeatureTable)
        action = msgspec.json.decode(_text(metadata["action"]), type=ActionSpec)
        # Without both spaces minari would make the environment that the metadata name, and run code of their choice.
        observed = set(json.loads(metadata["observation_space"])["subspaces"])
        json.loads(metadata["action_space"])
    except (KeyError, TypeError, ValueError, msgspec.DecodeError) as error:
        raise TracesError(
            f"{path}: metadata must hold 'features', 'action', 'observation_space' and 'action_space': {error}"
        ) from error
    if not {"free", "costly"} <= observed:
        raise TracesError(f"{path}: observations hold {sorted(observed)}, expected 'free' and 'costly'")
    return minari.MinariDataset(data), features, action


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _rows(where: str, name: str, array: NDArray[np.floating], shape: tuple[int, ...], dtype: type) -> Tensor:
    """The array as it is kept; numbers that do not fit `dtype` are refused like any that are not finite."""
    if array.shape != shape:
        raise TracesError(f"{where}: {name} has shape {array.shape}, expected {shape}")
    with np.errstate(over="ignore"):
        kept = array.astype(dtype)
    if not np.isfinite(kept).all():
        raise TracesError(f"{where}: {name} has numbers that are not finite as {np.dtype(dtype)}")
    return torch.from_numpy(kept)


def _refuse_links(folder: Path) -> None:
    """An HDF5 file may point at other files; a dataset from outside must not (nor may its files be links, nor its
    groups form anything but a tree)."""
    for file in folder.glob("*.hdf5"):
        if file.is_symlink():
            raise TracesError(f"{file} is a symbolic link, expected a regular file")
        with h5py.File(file) as root:
            groups, seen = [root], {h5py.h5o.get_info(root.id).addr}
            while groups:
                group = groups.pop()
                for name in group:
                    link = group.get(name, getlink=True)
                    if not isinstance(link, h5py.HardLink):
                        raise TracesError(f"{file}: {group.name}/{name} is a {type(link).__name__}, expected data")
                    child = group[name]
                    if isinstance(child, h5py.Group):
                        address = h5py.h5o.get_info(child.id).addr
                        if address in seen:
                            raise TracesError(f"{file}: {group.name}/{name} is a group that has another place as well")
                        seen.add(address)
                        groups.append(child)
                    elif child.external or child.is_virtual:
                        raise TracesError(f"{file}: {child.name} keeps its data in another file, expected it inside")
