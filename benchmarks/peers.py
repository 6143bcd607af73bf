"""How many times faster is a turn of ours than the same step in public Decision Transformers?

One decision of a bot, at one bot and at 64. *Ours*: both graphs of the bundle, sampling, allocation and bookkeeping, in
process and over the server's own doors. *Peers*: Hugging Face transformers' model (one batch; with either of its
attentions, the faster of which counts) and d3rlpy's (its API takes one bot at a time: 64 bots are 64 calls), with the
bundle's layers, heads, width, context and number of inputs and random weights, under `torch.inference_mode` on one
thread as ours, their windows full and recomputed every step as their documentation does (`benchmarks.peer_policies`).
torch.compile, exports of theirs and a cache of keys are not tried. Then a WebSocket policy server as the robotics
projects build theirs (`benchmarks.policy_server`), with Hugging Face's model behind it and with our own bots, which
tells transport from model.

One run: every round gives each row a slice of time and takes its median, so that all rows see the same machine. A ratio
is the median over rounds of a row's time by that of ours, in process, in the same round; `ratio_1` and `ratio_64` are
those of the fastest peer in process. Servers are on one core and this process on another, where there are two. µs are
per bot.

    make bench-peers
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.clocks import Clock

__all__ = ["Peers", "Row", "as_line", "fastest", "main", "measure", "missing"]

_NEEDED = ("torch", "transformers", "d3rlpy", "websockets")
_NOT_PEERS = ("ours", "policy server")
_MOST_STEPS = 1000  # of a row in one slice


@dataclass(frozen=True)
class Peers:
    """Time a turn of ours and the same step of others."""

    bundle: Path = Path("bundles/hard")
    int8: Path = Path("bundles/hard-int8")  # its int8 variant; left out where there is no such folder
    bots: tuple[int, ...] = (1, 64)
    rounds: int = 40
    slice_s: float = 0.05  # of each row in each round; at least one step
    clock: Clock = "wall"  # cpu: this thread's own time, for a machine that others use; only what is in process then
    pin: bool = True  # give servers a core of their own, where there are two
    json: bool = False  # print one JSON line instead of a table


@dataclass(frozen=True)
class Row:
    """µs a bot of one way to decide: the median of each round, [rounds]."""

    name: str
    n_bots: int
    us_R: NDArray[np.float64]

    def ratio(self, ours: Row) -> float:
        """How many times as long as ours it takes: the median over rounds."""
        return float(np.median(self.us_R / ours.us_R))


def missing() -> list[str]:
    """The packages of the extra `peers` that are not there."""
    return [name for name in _NEEDED if importlib.util.find_spec(name) is None]


def measure(config: Peers, console: Console) -> list[Row]:
    """Every row at every number of bots. Raises ImportError without the extra `peers`, OSError, BadBundle."""
    from benchmarks.peer_rows import PeerRows  # torch and others

    rows: list[Row] = []
    int8 = config.int8 if config.int8.is_dir() else None
    with ExitStack() as stack:
        made = PeerRows(config.bundle, int8, max(config.bots), stack, clock=config.clock, pin=config.pin)
        progress = stack.enter_context(Progress(console=console))
        task = progress.add_task("rounds", total=len(config.bots) * (config.rounds + 1))
        for n_bots in config.bots:
            with ExitStack() as clients:
                steps = dict(made.steps(n_bots, clients))
                for step in steps.values():
                    for _ in range(made.warm_up):
                        step()
                progress.advance(task)
                medians: dict[str, list[float]] = {name: [] for name in steps}
                for _ in range(config.rounds):
                    for name, step in steps.items():
                        medians[name].append(_median_us(step, config.slice_s))
                    progress.advance(task)
            rows += [Row(name, n_bots, np.array(us) / n_bots) for name, us in medians.items()]
    return rows


def fastest(rows: Sequence[Row], ours: Row) -> Row:
    """The fastest peer in process at the same number of bots."""
    peers = [row for row in rows if row.n_bots == ours.n_bots and not row.name.startswith(_NOT_PEERS)]
    return min(peers, key=lambda row: row.ratio(ours))


def as_line(rows: Sequence[Row]) -> dict[str, object]:
    """The figures of the JSON line: `ratio_N`, and `ratio_N_int8` (None where it was not measured)."""
    line: dict[str, object] = {}
    for ours in (row for row in rows if row.name == "ours"):
        best = fastest(rows, ours)
        line[f"ratio_{ours.n_bots}"] = round(best.ratio(ours), 1)
        int8 = next((row for row in rows if row.name == "ours, int8" and row.n_bots == ours.n_bots), None)
        line[f"ratio_{ours.n_bots}_int8"] = None if int8 is None else round(best.ratio(int8), 1)
        line[f"fastest_{ours.n_bots}"] = best.name
        same = [row for row in rows if row.n_bots == ours.n_bots]
        line[f"us_{ours.n_bots}"] = {row.name: round(float(np.median(row.us_R)), 1) for row in same}
    return line


def _median_us(step: Callable[[], float], slice_s: float) -> float:
    times: list[float] = []
    while not times or (len(times) < _MOST_STEPS and sum(times) < 1e6 * slice_s):
        times.append(step())
    return float(np.median(times))


def _table(rows: Sequence[Row]) -> Table:
    table = Table(title=f"one decision of a bot (load {os.getloadavg()[0]:.1f})")
    for name in ("", "bots", "times ours", "of rounds, 10 to 90 %", "µs a bot"):
        table.add_column(name, justify="left" if name == "" else "right")
    ours = {row.n_bots: row for row in rows if row.name == "ours"}
    for row in sorted(rows, key=lambda row: row.n_bots):
        than = ours[row.n_bots]
        low, high = np.percentile(row.us_R / than.us_R, (10, 90))
        table.add_row(
            row.name,
            str(row.n_bots),
            f"{row.ratio(than):.2f}",
            f"{low:.2f} to {high:.2f}",
            f"{np.median(row.us_R):,.1f}",
        )
    return table


def main(config: Peers) -> int:
    """Print the table or the JSON line; the exit status, 2 where the extra is missing."""
    if lacking := missing():
        print(
            f"benchmarks.peers needs {', '.join(lacking)}, of the extra `peers`. d3rlpy wants an older "
            "gymnasium than the game, so they have a venv of their own: make bench-peers",
            file=sys.stderr,
        )
        return 2
    rows = measure(config, Console(stderr=True))
    if config.json:
        print(json.dumps({**as_line(rows), "load": round(os.getloadavg()[0], 2)}))
    else:
        Console().print(_table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Peers, description=__doc__)))
