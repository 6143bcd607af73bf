"""Writing a Minari dataset, an episode at a time: it appears under its name when it is whole, or not at all.

This module knows nothing about where episodes come from.
"""

from __future__ import annotations

import importlib.metadata
import os
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Space
from minari.dataset.minari_dataset import DATASET_ID_RE
from minari.dataset.minari_storage import MinariStorage

from training.episodes import Episode
from training.sink import Sink

__all__ = ["DatasetWriter"]


class DatasetWriter:
    """Collects episodes beside `out`, and becomes `out` with `finish`; without it, nothing is left."""

    def __init__(self, out: Path) -> None:
        """Raises ValueError unless `out` can be a new dataset's folder, and OSError."""
        match = DATASET_ID_RE.fullmatch(out.name)
        if match is None or match.group("version") is None:
            raise ValueError(f"{out}: a dataset's folder has a name and a version, such as arena-expert-v0")
        if out.exists() or out.is_symlink():
            raise ValueError(f"{out} is there already, and nothing is replaced")
        if not out.parent.is_dir():
            raise ValueError(f"{out.parent} is not a folder, expected the one that {out.name} goes into")
        self.episodes = self.steps = 0
        """How many have been added."""
        self._out = out
        self._scratch = tempfile.TemporaryDirectory(dir=out.parent, prefix=".dataset-")
        self._main = Path(self._scratch.name) / "main.hdf5"
        self._sink = Sink(self._main)
        self._file = h5py.File(self._sink, "w", track_order=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._sink.close()
        self._scratch.cleanup()

    def add(self, episode: Episode) -> None:
        """Write the groups that Minari reads, compressed, as game/recording.py does. Raises OSError, for a full disk
        soon after it is full."""
        n = len(episode.rewards)
        last_T = np.arange(n) == n - 1
        group = self._file.create_group(f"episode_{self.episodes}")
        group.attrs["id"], group.attrs["total_steps"] = self.episodes, n
        for key, values in episode.observations.items():
            name = f"observations/{key}" if key else "observations"
            packing = {"chunks": values.shape, "compression": "lzf", "shuffle": True} if values.size else {}
            group.create_dataset(name, data=values, **packing)
        group["actions"], group["rewards"] = episode.actions, episode.rewards
        group["terminations"], group["truncations"] = last_T & episode.terminated, last_T & episode.truncated
        self._sink.check()
        self.episodes += 1
        self.steps += n

    def finish(self, spaces: tuple[Space, Space], metadata: dict[str, Any], env_spec: EnvSpec | None = None) -> None:
        """Give the dataset its spaces (of observations, of actions), its metadata and its name. Raises OSError."""
        self._file.close()
        self._sink.check()
        self._sink.close()
        folder = Path(self._scratch.name) / self._out.name
        folder.mkdir()
        storage = MinariStorage.new(
            folder.resolve() / "data",  # Minari joins a relative path to itself
            observation_space=spaces[0],
            action_space=spaces[1],
            env_spec=env_spec,
            jpeg_encoding=False,
        )
        os.replace(self._main, folder / "data" / "main_data.hdf5")
        storage.update_metadata(
            {
                "dataset_id": self._out.name,
                "total_episodes": self.episodes,
                "total_steps": self.steps,
                "dataset_size": storage.get_size(),
                "minari_version": importlib.metadata.version("minari"),
                **metadata,
            }
        )
        os.rename(folder, self._out)
