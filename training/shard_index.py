"""`shards.json`, what is known of a folder of shards without reading them.

This module knows nothing about Parquet or training.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from protocol.features import ActionSpec, FeatureTable
from training.datasets import TracesError
from training.feature_map import FeatureMap
from training.statistics import Statistics
from training.steps import Layout

__all__ = ["EXAMPLE", "GroupSize", "ShardIndex", "is_sharded", "shard_name"]

EXAMPLE = "example.parquet"  # how one of the first episodes begins, in a shard's form
_INDEX = "shards.json"
_MOST_BYTES = 2**28
_FORM = 1


def shard_name(number: int) -> str:
    """Name of a shard's file."""
    return f"{number:06d}.parquet"


def is_sharded(folder: Path) -> bool:
    """Whether this is a folder of shards."""
    return (folder / _INDEX).is_file()


class GroupSize(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """How much a row group holds."""

    n_steps: int
    n_episodes: int

    def __post_init__(self) -> None:
        if not 1 <= self.n_episodes <= self.n_steps:
            raise ValueError(f"a row group has {self.n_episodes} episodes and {self.n_steps} timesteps")


class ShardIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a folder of shards holds. Raises ValueError."""

    features: FeatureTable
    action: ActionSpec
    statistics: Statistics
    shards: tuple[tuple[GroupSize, ...], ...]  # the row groups of each
    example_steps: int
    choices: int | None = None
    feature_map: FeatureMap | None = None
    form: int = _FORM

    def __post_init__(self) -> None:
        if self.form != _FORM:
            raise ValueError(f"form is {self.form}, expected {_FORM}")
        told = (self.statistics.n_steps, self.statistics.n_episodes)
        groups = [group for shard in self.shards for group in shard]
        counted = (sum(group.n_steps for group in groups), sum(group.n_episodes for group in groups))
        if told != counted:
            raise ValueError(f"the row groups hold {counted} timesteps and episodes, the statistics are of {told}")
        sizes = (("free", self.features.n_free), ("costly", self.features.n_costly), ("returns_to_go", 1))
        for name, size in sizes:
            if len(getattr(self.statistics, name).mean) != size:
                raise ValueError(
                    f"statistics of {name} are of {len(getattr(self.statistics, name).mean)} numbers, expected {size}"
                )

    @property
    def layout(self) -> Layout:
        """What the numbers of a timestep are."""
        return Layout(self.features, self.action, self.choices, self.feature_map)

    @classmethod
    def read(cls, folder: Path) -> ShardIndex:
        """Read a folder's index. Raises TracesError naming the file and the field."""
        path = folder / _INDEX
        try:
            if path.stat().st_size > _MOST_BYTES:
                raise ValueError(f"{path.stat().st_size} bytes, expected at most {_MOST_BYTES}")
            return msgspec.json.decode(path.read_bytes(), type=cls)
        except (OSError, ValueError) as error:
            raise TracesError(f"{path}: {error}") from error

    def write(self, folder: Path) -> None:
        """Write what `read` reads."""
        (folder / _INDEX).write_bytes(msgspec.json.encode(self) + b"\n")
