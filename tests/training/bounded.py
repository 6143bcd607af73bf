"""How much a process grows while it trains on streamed traces: one line of JSON, in MB. Run by test_stream."""

from __future__ import annotations

import json
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from protocol.features import Feature, FeatureTable
from tests.training import toy
from training.shards import write_shards
from training.steps import Layout, Steps
from training.stream import Pooling, Stream
from training.train import train

TOTAL_MB, POOL_MB, GROUP_MB, LENGTH = 128, 16, 2, 200
LAYOUT = Layout(FeatureTable((Feature("here", 2), Feature("seen", 245, 1.0))), toy.ACTION)  # 1 kB a timestep


def episodes(total_mb: int) -> Iterator[Steps]:
    """Made-up ones; only returns-to-go differ."""
    chance = torch.Generator().manual_seed(0)
    costly = torch.rand(LENGTH, 245, generator=chance)
    free, actions = torch.zeros(LENGTH, 2), torch.zeros(LENGTH, 2)
    for i in range(int(total_mb * 1e3 / LENGTH)):
        yield Steps(free, costly, actions, torch.arange(LENGTH, 0, -1) * (1.0 + i % 7))


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(folder: Path, total_mb: int, updates: int) -> None:
    """An update draws as many timesteps as a row group holds: each brings another one."""
    write_shards(LAYOUT, episodes(total_mb), folder / "shards", shard_mb=64.0, group_mb=GROUP_MB)
    settings = {"method": "rcbc", "batch": 100, "window": 20, "pool_mb": POOL_MB, "updates": updates}
    train(toy.config(folder / "shards", folder / "run", log_every=updates, **settings))


def main() -> None:
    torch.set_num_threads(1)
    small, large = (Path(sys.argv[1]) / name for name in ("small", "large"))
    for folder in (small, large):
        folder.mkdir()
    run(small, 2 * POOL_MB, 8)
    before = peak_mb()
    run(large, TOTAL_MB, TOTAL_MB // GROUP_MB)
    streamed = peak_mb() - before
    Stream.open(large / "shards", Pooling(2.0 * TOTAL_MB, 100, 0)).pool(0)
    print(json.dumps({"streamed": streamed, "all": peak_mb() - before}))


if __name__ == "__main__":
    main()
