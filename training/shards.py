"""Traces as shards, to be streamed: `python -m training.shards DATASET... OUT`, then OUT as a run's dataset.

Minari datasets are read an episode at a time and written as Parquet (training/shard.py) with the statistics that
training needs (training/shard_index.py), so that a run reads only what it draws from. OUT appears when all of it is
written, or not at all. Memory is that of a row group, of the first episodes, and 4 bytes an episode.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.progress import track

from training.command import command, terminable
from training.feature_map import FeatureMap
from training.shard import ShardWriter, step_bytes
from training.shard_index import EXAMPLE, GroupSize, ShardIndex, shard_name
from training.statistics import Tally
from training.steps import Layout, Recordings, Steps
from training.traces import EXAMPLE_STEPS

__all__ = ["ShardsConfig", "main", "write_shards"]


@dataclass(frozen=True)
class ShardsConfig:
    """What is written, and how large its pieces are. Raises ValueError."""

    paths: tyro.conf.Positional[tuple[Path, ...]]  # Minari datasets, an episode of each in turn; last, a folder to make
    feature_map: Path | None = None  # what the observations' numbers are (None: the datasets themselves tell)
    episodes: int | None = None  # only the first so many episodes of each dataset (None: all)
    shard_mb: float = 256.0  # size of a file, in memory
    group_mb: float = 8.0  # size of a row group, what is read at once; it holds one episode at least

    def __post_init__(self) -> None:
        if len(self.paths) < 2:
            raise ValueError(f"paths are {len(self.paths)}, expected one dataset or more and the folder to make")
        if not 0.0 < self.group_mb <= self.shard_mb:
            raise ValueError(f"group_mb is {self.group_mb}, expected above 0 and at most shard_mb, {self.shard_mb}")


def write_shards(
    layout: Layout, episodes: Iterable[Steps], out: Path, shard_mb: float = 256.0, group_mb: float = 8.0
) -> ShardIndex:
    """Write a folder of shards. Raises ValueError where `out` cannot be made, and what reading an episode raises; then
    `out` is not there."""
    if out.exists() or out.is_symlink():
        raise ValueError(f"{out} is there already, expected a folder to make")
    if not out.parent.is_dir():
        raise ValueError(f"{out.parent} is not a folder, expected the one that {out.name} goes into")
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".shards-") as scratch:
        folder = Path(scratch) / out.name
        folder.mkdir()
        shards = _Shards(folder, layout, shard_mb, group_mb)
        for episode in episodes:
            shards.add(episode)
        index = shards.finish()
        os.rename(folder, out)
    return index


class _Shards:
    """The shards that are being written."""

    def __init__(self, folder: Path, layout: Layout, shard_mb: float, group_mb: float) -> None:
        self._folder, self._layout = folder, layout
        self._most_steps = [int(mb * 1e6 / step_bytes(layout)) for mb in (group_mb, shard_mb)]
        self._tally = Tally()
        self._example: Steps | None = None  # how the first of the longest episodes begins
        self._group: list[Steps] = []  # episodes that are not written yet,
        self._n_steps = 0  # and their timesteps
        self._sizes: list[list[GroupSize]] = []
        self._written = 0  # episodes
        self._writer: ShardWriter | None = None

    def add(self, episode: Steps) -> None:
        self._tally.add(episode)
        n_steps = len(episode.returns_to_go_T)
        if self._example is None or len(self._example.returns_to_go_T) < min(n_steps, EXAMPLE_STEPS):
            self._example = episode.part(slice(0, EXAMPLE_STEPS))
        if self._group and self._n_steps + n_steps > self._most_steps[0]:
            self._write_group()
        self._group.append(episode)
        self._n_steps += n_steps

    def finish(self) -> ShardIndex:
        """Write what is left, and the index. Raises ValueError when there was no episode."""
        if self._example is None:
            raise ValueError(f"{self._folder.name}: no episodes, expected one or more")
        self._write_group()
        self._close()
        example, layout = self._example, self._layout
        writer = ShardWriter(self._folder / EXAMPLE, layout)
        writer.write(0, [example])
        writer.close()
        index = ShardIndex(
            layout.features,
            layout.action,
            self._tally.statistics(),
            tuple(tuple(shard) for shard in self._sizes),
            len(example.returns_to_go_T),
            layout.choices,
            layout.feature_map,
        )
        index.write(self._folder)
        return index

    def _write_group(self) -> None:
        if self._writer and sum(size.n_steps for size in self._sizes[-1]) + self._n_steps > self._most_steps[1]:
            self._close()
        if self._writer is None:
            self._writer = ShardWriter(self._folder / shard_name(len(self._sizes)), self._layout)
            self._sizes.append([])
        self._writer.write(self._written, self._group)
        self._sizes[-1].append(GroupSize(self._n_steps, len(self._group)))
        self._written += len(self._group)
        self._group, self._n_steps = [], 0

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    with command("stopped: nothing was written"), terminable():
        config = tyro.cli(ShardsConfig, args=arguments, description=__doc__)
        feature_map = None if config.feature_map is None else FeatureMap.read(config.feature_map)
        *datasets, out = config.paths
        recordings = Recordings(datasets, config.episodes, feature_map)
        episodes = track(recordings, description=f"reading {recordings.names}")
        index = write_shards(recordings.layout, episodes, out, config.shard_mb, config.group_mb)
    n_groups = sum(map(len, index.shards))
    counts = f"{index.statistics.n_episodes} episodes, {index.statistics.n_steps} timesteps"
    Console().print(f"{out}: {counts} in {len(index.shards)} shards of {n_groups} row groups", soft_wrap=True)


if __name__ == "__main__":
    main()
