"""What the two graphs of bundles take alone, by the number of bots: no allocation, no bots' state, no wire.

Bundles take turns within each round, so that all see the same machine; a ratio is the median over rounds of a bundle's
time by that of the first one. What a turn takes is more: weights have left the caches by then (benchmarks.latency).

    python -m benchmarks.graphs bundles/hard bundles/hard-int8
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.policy import Policy

__all__ = ["Graphs", "Row", "main", "measure", "ratio"]

_LOW = 20  # percentile of a slice: other work only ever makes a run longer
_WARM_UP = 20


@dataclass(frozen=True)
class Graphs:
    """Time the acquisition and the action graph of bundles."""

    bundles: tyro.conf.Positional[tuple[Path, ...]] = (Path("bundles/hard"), Path("bundles/hard-int8"))
    bots: tuple[int, ...] = (1, 8, 64, 256)
    rounds: int = 12
    slice_s: float = 0.04  # of each graph in each round; at least one run
    json: bool = False  # print one JSON line instead of a table


@dataclass(frozen=True)
class Row:
    """µs of a graph for all bots together, [rounds]."""

    bundle: str
    graph: str
    n_bots: int
    us_R: NDArray[np.float64]


def measure(config: Graphs) -> list[Row]:
    """Every graph of every bundle at every number of bots. Raises BadBundle."""
    bundles = [Bundle.load(path) for path in config.bundles]
    rows: list[Row] = []
    for n_bots in config.bots:
        named = zip(config.bundles, bundles, strict=True)
        runs = [(str(path), graph, run) for path, each in named for graph, run in _runs(each, n_bots).items()]
        us_GR = np.array([[_low_us(run, config.slice_s) for _, _, run in runs] for _ in range(config.rounds)]).T
        rows += [Row(name, graph, n_bots, us_R) for (name, graph, _), us_R in zip(runs, us_GR, strict=True)]
    return rows


def ratio(row: Row, rows: Sequence[Row]) -> float:
    """How many times as long as the first bundle's it takes: the median over rounds."""
    first = next(each for each in rows if (each.graph, each.n_bots) == (row.graph, row.n_bots))
    return float(np.median(row.us_R / first.us_R))


def _runs(bundle: Bundle, n_bots: int) -> dict[str, Callable[[], object]]:
    """A run of each graph on full rings, of made-up numbers."""
    manifest, policy, random = bundle.manifest, Policy(bundle), np.random.default_rng(0)
    batch = Contexts(manifest, n_bots).batch(np.arange(n_bots))
    for array in (batch.before_NX, batch.prepared_NE, batch.acquired_NY, batch.memory):
        array[...] = 0.3 * random.normal(size=array.shape)
    batch.target_cost_N1[:], batch.place_N[:] = 0.1, manifest.n_slots
    runs = {"acquisition": lambda: policy.query_probs(batch), "action": lambda: policy.act(batch)}
    for run in runs.values():
        for _ in range(_WARM_UP):
            run()
    return runs


def _low_us(run: Callable[[], object], slice_s: float) -> float:
    times_ns: list[int] = []
    while not times_ns or sum(times_ns) < 1e9 * slice_s:
        begun = time.perf_counter_ns()
        run()
        times_ns.append(time.perf_counter_ns() - begun)
    return float(np.percentile(times_ns, _LOW)) / 1e3


def _table(rows: Sequence[Row]) -> Table:
    table = Table(title=f"µs of a graph (load {os.getloadavg()[0]:.1f})")
    for name in ("graph", "bots", "bundle", "least", "µs", "times the first"):
        table.add_column(name, justify="left" if name in ("graph", "bundle") else "right")
    for row in sorted(rows, key=lambda row: row.graph):
        us = f"{row.us_R.min():,.1f}", f"{np.median(row.us_R):,.1f}"
        table.add_row(row.graph, str(row.n_bots), row.bundle, *us, f"{ratio(row, rows):.2f}")
    return table


def main(config: Graphs) -> int:
    """Print the table or the JSON line; the exit status."""
    rows = measure(config)
    if config.json:
        line = {f"{row.bundle}_{row.graph}_{row.n_bots}": round(float(np.median(row.us_R)), 1) for row in rows}
        print(json.dumps({**line, "load": round(os.getloadavg()[0], 2)}))
    else:
        Console().print(_table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Graphs, description=__doc__)))
