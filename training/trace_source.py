"""Where a run's traces come from: memory, or a stream."""

from __future__ import annotations

from typing import Protocol, Self

from training.config import TrainConfig
from training.feature_map import FeatureMap
from training.shard_index import is_sharded
from training.statistics import Statistics
from training.steps import Layout, Steps
from training.stream import Pooling, Stream
from training.traces import Traces, load_traces

__all__ = ["TraceSource", "open_traces"]


class TraceSource(Protocol):
    """Episodes, in memory or not: what training knows of them, and what it draws windows from."""

    @property
    def layout(self) -> Layout:
        """What the numbers of a timestep are."""

    @property
    def statistics(self) -> Statistics:
        """Of all episodes that were opened."""

    @property
    def example(self) -> Steps:
        """How the first of the longest episodes begins."""

    def __len__(self) -> int:
        """How many episodes there are."""

    def to(self, device: str) -> Self:
        """The same, what is drawn from on `device`."""

    def split(self, share: float) -> tuple[Self, Self]:
        """All but the last `share` of the episodes, and those: what is trained on, and what is held out."""

    def pool(self, update: int) -> Traces:
        """What windows are drawn from at an update; only until the next pool."""


def open_traces(config: TrainConfig) -> TraceSource:
    """A folder of shards is streamed, Minari datasets are read. Raises TracesError for what is neither or does not
    match, ValueError for settings that shards were told when they were written."""
    if not is_sharded(config.dataset):
        feature_map = None if config.feature_map is None else FeatureMap.read(config.feature_map)
        paths = (config.dataset, *config.more_datasets)
        return load_traces(*paths, episodes=config.episodes, feature_map=feature_map)
    for name, expected in (("more_datasets", ()), ("episodes", None), ("feature_map", None)):
        if getattr(config, name) != expected:
            raise ValueError(
                f"{name} is {getattr(config, name)}, expected none: {config.dataset} is a folder of shards, and "
                "training.shards takes such settings when it writes them"
            )
    return Stream.open(config.dataset, Pooling(config.pool_mb, config.batch * config.window, config.seed))
