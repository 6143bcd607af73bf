"""Memory and speed of streamed traces beside the same traces in memory: `python -m benchmarks.streaming`.

Made-up traces of the navigation game's sizes are written as shards; then the same updates are made twice in this
process, windows drawn from a pool of `pool_mb`, and from a pool that holds everything. Memory is what the process's
peak grows by over what it was after updates on a small part. A network without memory trains: the quicker an update,
the more reading weighs. Linux only: the peak is read from /proc.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from game.env import ACTION_SPEC, feature_table
from training.config import TrainConfig
from training.shard import step_bytes
from training.shards import write_shards
from training.steps import Layout, Steps, costly_type
from training.trace_source import open_traces
from training.update import new_state, update

__all__ = ["Streaming", "main", "measure"]

_LENGTH = 200  # timesteps of an episode
_WARM_UP = 5  # updates


@dataclass(frozen=True)
class Streaming:
    """What is written, and how much of it may be in memory."""

    total_mb: float = 2000.0
    pool_mb: float = 250.0
    group_mb: float = 8.0
    updates: int = 200
    batch: int = 40  # windows
    window: int = 60  # timesteps
    threads: int = 1
    seed: int = 0
    json: bool = False  # print one JSON line instead of a table


def _episodes(layout: Layout, total_mb: float, seed: int) -> Iterator[Steps]:
    """Ones of which only returns-to-go differ: what is read is as large, and they are made quickly."""
    chance, features = torch.Generator().manual_seed(seed), layout.features
    low = torch.tensor([component.low for component in layout.action.components])
    high = torch.tensor([component.high for component in layout.action.components])
    free = torch.randn(_LENGTH, features.n_free, generator=chance)
    costly = torch.rand(_LENGTH, features.n_costly, generator=chance)
    costly = torch.from_numpy(costly.numpy().astype(costly_type(features)))
    actions = low + (high - low) * torch.rand(_LENGTH, len(low), generator=chance)
    for i in range(max(1, int(total_mb * 1e6 / step_bytes(layout) / _LENGTH))):
        yield Steps(free, costly, actions, torch.arange(_LENGTH, 0, -1) * (1.0 + i % 7))


def _write(asked: Streaming, folder: Path, total_mb: float) -> Path:
    layout = Layout(feature_table(), ACTION_SPEC)
    n_episodes = total_mb * 1e6 / step_bytes(layout) / _LENGTH
    episodes = track(_episodes(layout, total_mb, asked.seed), "writing shards", total=n_episodes, transient=True)
    write_shards(layout, episodes, folder, group_mb=asked.group_mb)
    return folder


def _peak_mb() -> float:
    """Of this process; what getrusage tells begins with that of the process that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) * 1024 / 1e6


def _updates_per_s(asked: Streaming, folder: Path, pool_mb: float, updates: int) -> float:
    """Make so many updates; the first pool is read before time counts."""
    settings = {"bins": (11, 6, 2), "method": "rcbc", "batch": asked.batch, "window": asked.window, "seed": asked.seed}
    config = TrainConfig(folder, Path(), "benchmark", pool_mb=pool_mb, updates=updates, **settings)
    traces = open_traces(config)
    state, costs_M = new_state(config, traces), torch.tensor(traces.layout.features.costs_us, dtype=torch.float32)
    traces.pool(0)
    began = time.perf_counter()
    for number in track(range(updates), f"pool of {pool_mb:g} MB", transient=True):
        update(config, state, traces.pool(number), costs_M)
    return updates / (time.perf_counter() - began)


def measure(asked: Streaming) -> dict[str, float]:
    """MB that the process grew by, and updates a second, each way."""
    torch.set_num_threads(asked.threads)
    with tempfile.TemporaryDirectory(prefix="streaming-") as scratch:
        small = _write(asked, Path(scratch) / "small", 4 * asked.group_mb)
        _updates_per_s(asked, small, 4 * asked.group_mb, _WARM_UP)
        large = _write(asked, Path(scratch) / "large", asked.total_mb)
        begun = _peak_mb()
        streamed = _updates_per_s(asked, large, asked.pool_mb, asked.updates)
        streamed_mb = _peak_mb() - begun
        kept = _updates_per_s(asked, large, asked.total_mb + 4 * asked.group_mb, asked.updates)
        kept_mb = _peak_mb() - begun
    rates = {"streamed_per_s": streamed, "in_memory_per_s": kept, "ratio": streamed / kept}
    return {"streamed_mb": streamed_mb, "in_memory_mb": kept_mb, **rates}


def main() -> None:
    """Command line."""
    asked = tyro.cli(Streaming, description=__doc__)
    measured = measure(asked)
    if asked.json:
        print(json.dumps(asdict(asked) | measured))
        return
    table = Table(title=f"{asked.total_mb:g} MB of traces, {asked.updates} updates of {asked.batch} x {asked.window}")
    for column in ("traces", "allowed, MB", "grown by, MB", "updates/s"):
        table.add_column(column, justify="right")
    for name, allowed in (("streamed", asked.pool_mb), ("in_memory", asked.total_mb)):
        numbers = (f"{allowed:g}", f"{measured[f'{name}_mb']:.0f}", f"{measured[f'{name}_per_s']:.1f}")
        table.add_row(name.replace("_", " "), *numbers)
    Console().print(table)


if __name__ == "__main__":
    main()
