"""Traces that are streamed: of a folder of shards, a pool of row groups is in memory, however large the folder is.

Windows are drawn from the pool as they are drawn from traces in memory. Row groups pass through it (training/rota.py);
each stays about until as many timesteps were drawn of it as it holds. Which are in the pool at an update follows from
the seed and the update's number alone, so that a resumed run has nothing to restore. Where everything fits, the run is
that of the same traces in memory. This module knows nothing about networks.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from training.rota import Rota
from training.shard import Group, read_group, step_bytes
from training.shard_index import EXAMPLE, ShardIndex, shard_name
from training.statistics import Statistics
from training.steps import Layout, Steps, costly_type
from training.traces import Traces

__all__ = ["Pooling", "Stream"]

_SPARE = 2  # row groups in memory that are not drawn from: one that was read ahead, one that is being read


class Pooling(NamedTuple):
    """How a folder of shards is gone through."""

    pool_mb: float  # most memory for traces
    draws: int  # timesteps in an update
    seed: int


class _Place(NamedTuple):
    """Where a row group is."""

    shard: int
    number: int  # in its shard
    n_steps: int


class Stream:
    """Some of the episodes of a folder of shards, first to last."""

    def __init__(
        self, folder: Path, index: ShardIndex, pooling: Pooling, device: str = "cpu", episodes: range | None = None
    ) -> None:
        """Raises ValueError where row groups are too large for the pool."""
        self._folder, self._index, self._pooling, self._device = folder, index, pooling, device
        self._episodes = range(self.statistics.n_episodes) if episodes is None else episodes
        self._places = _places(index, self._episodes)
        self._rota = self._make_rota()
        self._slots: _Slots | None = None  # made when windows are drawn
        self._reader = ThreadPoolExecutor(1, "traces")
        self._ahead: tuple[int, Future[Group]] | None = None  # position, and what is read of it

    @classmethod
    def open(cls, folder: Path, pooling: Pooling) -> Stream:
        """All of a folder. Raises TracesError where it is none of shards."""
        return cls(folder, ShardIndex.read(folder), pooling)

    def __len__(self) -> int:
        """How many episodes there are."""
        return len(self._episodes)

    @property
    def layout(self) -> Layout:
        """What the numbers of a timestep are."""
        return self._index.layout

    @property
    def statistics(self) -> Statistics:
        """Of all episodes of the folder."""
        return self._index.statistics

    @property
    def example(self) -> Steps:
        """How one of the first episodes begins."""
        return read_group(self._folder / EXAMPLE, 0, self.layout, self._index.example_steps).steps

    def to(self, device: str) -> Stream:
        """The same episodes, their pool on `device`."""
        return Stream(self._folder, self._index, self._pooling, device, self._episodes)

    def split(self, share: float) -> tuple[Stream, Stream]:
        """All but the last `share` of the episodes, and those: what is trained on, and what is held out."""
        first = len(self) - round(share * len(self))
        parts = (self._episodes[:first], self._episodes[first:])
        return tuple(Stream(self._folder, self._index, self._pooling, self._device, part) for part in parts)

    def pool(self, update: int) -> Traces:
        """What windows are drawn from at an update; the next one's numbers may take their place in memory."""
        positions = self._rota.positions(update)
        if self._slots is None:
            slot_steps = max(place.n_steps for place in self._places)
            self._slots = _Slots(self.layout, self._rota.n_slots, slot_steps, self._device, self._episodes)
        for position in positions:
            slot = position % self._rota.n_slots
            if self._slots.held[slot] != position:
                self._slots.put(slot, position, self._group(position))
        if self._rota.n_slots < self._rota.n_groups and (self._ahead is None or self._ahead[0] != positions.stop):
            self._ahead = (positions.stop, self._reader.submit(self._read, positions.stop))
        return self._slots.traces()

    def _group(self, position: int) -> Group:
        if self._ahead is not None and self._ahead[0] == position:
            (_, future), self._ahead = self._ahead, None
            return future.result()
        return self._read(position)

    def _read(self, position: int) -> Group:
        place = self._places[self._rota.group(position)]
        return read_group(self._folder / shard_name(place.shard), place.number, self.layout, place.n_steps)

    def _make_rota(self) -> Rota:
        n_groups = len(self._places)
        if not n_groups:
            return Rota(0, 0, 1, self._pooling.seed)
        sizes = [place.n_steps for place in self._places]
        group_mb = max(sizes) * step_bytes(self.layout) / 1e6
        n_slots = min(int(self._pooling.pool_mb / group_mb) - _SPARE, n_groups)
        if n_slots < 1:
            raise ValueError(
                f"pool_mb is {self._pooling.pool_mb:g}, expected at least {(1 + _SPARE) * group_mb:.3g}: "
                f"{1 + _SPARE} row groups of {self._folder}, whose largest takes {group_mb:.3g} MB"
            )
        updates = max(1, round(sum(sizes) / n_groups / self._pooling.draws))
        return Rota(n_groups, n_slots, updates, self._pooling.seed)


class _Slots:
    """Row groups in memory, each in a slot of one size."""

    def __init__(self, layout: Layout, n_slots: int, slot_steps: int, device: str, episodes: range) -> None:
        self._layout, self._slot_steps, self._episodes = layout, slot_steps, episodes
        n_steps, features = n_slots * slot_steps, layout.features
        costly = torch.float16 if costly_type(features) is np.float16 else torch.float32
        self._steps = Steps(
            torch.empty(n_steps, features.n_free, device=device),
            torch.empty(n_steps, features.n_costly, dtype=costly, device=device),
            torch.empty(n_steps, layout.action.size, device=device),
            torch.empty(n_steps, device=device),
        )
        self.held = [-1] * n_slots  # position in each
        self._starts: list[NDArray[np.int64]] = [np.empty(0, np.int64)] * n_slots
        self._lengths = self._starts.copy()
        self._traces: Traces | None = None

    def put(self, slot: int, position: int, group: Group) -> None:
        """Take a group in place of what was there; only the episodes that are wanted count."""
        first = slot * self._slot_steps
        for mine, theirs in zip(self._steps, group.steps, strict=True):
            mine[first : first + len(theirs)] = theirs
        number_E = group.first + np.arange(len(group.starts_E))
        wanted_E = (number_E >= self._episodes.start) & (number_E < self._episodes.stop)
        self._starts[slot], self._lengths[slot] = first + group.starts_E[wanted_E], group.lengths_E[wanted_E]
        self.held[slot], self._traces = position, None

    def traces(self) -> Traces:
        """All of them."""
        if self._traces is None:
            starts_E, lengths_E = np.concatenate(self._starts), np.concatenate(self._lengths)
            self._traces = Traces(self._layout, *self._steps, starts_E, lengths_E)
        return self._traces


def _places(index: ShardIndex, episodes: range) -> list[_Place]:
    """Row groups that hold any of these episodes."""
    places, first = [], 0
    for shard, groups in enumerate(index.shards):
        for number, group in enumerate(groups):
            if first < episodes.stop and first + group.n_episodes > episodes.start:
                places.append(_Place(shard, number, group.n_steps))
            first += group.n_episodes
    return places
