"""Episodes in, a Minari dataset out: the HDF5 layout that Minari reads, written compressed and in resumable shards.

Minari's own writer stores uncompressed; this one writes the same groups, so `minari.load_dataset` reads them.
This module knows nothing about players or physics.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Space
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray

__all__ = ["Episode", "Summary", "merge_shards", "summarise", "write_shard"]


@dataclass(frozen=True)
class Episode:
    """One recorded episode of T decisions; observations have one more row, the last one seen."""

    seed: int
    free: NDArray[np.float32]  # [T+1, F]
    costly: NDArray[np.float32]  # [T+1, D]
    actions: NDArray[np.float32]  # [T, A], as intended
    rewards: NDArray[np.float32]  # [T]
    terminations: NDArray[np.bool_]  # [T]
    truncations: NDArray[np.bool_]  # [T]


@dataclass(frozen=True)
class Summary:
    """What a set of episodes looks like: return and length of each, and how many ended in death."""

    returns: tuple[float, ...]
    lengths: tuple[int, ...]
    deaths: int


def write_shard(path: Path, episodes: Iterable[Episode]) -> None:
    """Write episodes to one file, which appears under its name only when it is complete."""
    partial = path.with_suffix(".partial")
    with h5py.File(partial, "w", track_order=True) as file:
        for i, episode in enumerate(episodes):
            group = file.create_group(f"episode_{i}")
            group.attrs["seed"] = episode.seed
            group.attrs["total_steps"] = len(episode.rewards)
            observations = group.create_group("observations")
            for key, values in (("free", episode.free), ("costly", episode.costly)):
                observations.create_dataset(key, data=values, chunks=values.shape, compression="lzf", shuffle=True)
            group["actions"], group["rewards"] = episode.actions, episode.rewards
            group["terminations"], group["truncations"] = episode.terminations, episode.truncations
    os.replace(partial, path)


def summarise(shard: Path) -> Summary:
    """Read back what a shard holds. A death is a termination short of the whole return."""
    returns, lengths, deaths = [], [], 0
    with h5py.File(shard) as file:
        for group in file.values():
            rewards = group["rewards"][()]
            returns.append(float(rewards.sum()))
            lengths.append(len(rewards))
            deaths += int(group["terminations"][-1] and rewards.sum() < 99.0)
    return Summary(tuple(returns), tuple(lengths), deaths)


def merge_shards(
    root: Path,
    dataset_id: str,
    shards: list[Path],
    env_spec: EnvSpec,
    spaces: tuple[Space, Space],
    metadata: dict[str, str],
) -> Path:
    """Join shards, in order, into the Minari dataset `root/dataset_id`; returns its folder. `metadata` goes with it."""
    data = root.resolve() / dataset_id / "data"  # Minari joins a relative path to itself
    building = data.with_name("building")
    shutil.rmtree(building, ignore_errors=True)
    building.mkdir(parents=True)
    storage = MinariStorage.new(
        building, observation_space=spaces[0], action_space=spaces[1], env_spec=env_spec, jpeg_encoding=False
    )
    count = steps = 0
    with h5py.File(building / "main_data.hdf5", "w", track_order=True) as file:
        for shard in shards:
            with h5py.File(shard) as source:
                for i in range(len(source)):
                    source.copy(f"episode_{i}", file, name=f"episode_{count}")
                    file[f"episode_{count}"].attrs["id"] = count
                    steps += int(file[f"episode_{count}"].attrs["total_steps"])
                    count += 1
    storage.update_metadata(
        {
            "dataset_id": dataset_id,
            "total_episodes": count,
            "total_steps": steps,
            "dataset_size": storage.get_size(),
            **metadata,
        }
    )
    shutil.rmtree(data, ignore_errors=True)
    os.replace(building, data)
    return data.parent
