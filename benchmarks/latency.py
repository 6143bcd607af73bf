"""How long does a turn take? In process, over a Unix socket, TCP, WebSocket and HTTP, for 1 to 256 bots.

A turn is one RequestQueries and one SubmitFeatures for all N bots: two round trips where there is a wire, without what
the engine does between them. *Model* is the time in the two ONNX graphs (the replies' `infer_us`); what is left is
allocation, bookkeeping, codec and transport. Rounds visit every transport in turn, so that the ratios hold when the
machine's speed drifts. The server is its own process; with two cores or more it has one to itself. The client is the
one in Python and, for `uds C` and `tcp C`, the one in C (clients/c), which is left out where there is no C compiler.

    python -m benchmarks.latency --json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.cores import set_apart
from benchmarks.engine import Engines, can_build
from benchmarks.recorded import Timed, in_process, over
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Latency", "main", "measure"]

_DOORS = {"uds": "unix", "tcp": "tcp", "ws": "ws", "http": "http"}
_C_DOORS = {"uds C": "unix", "tcp C": "tcp"}
_WARM_UP = 20
_ROUND = 50  # turns of one transport before the next has its turn
_QUANTILES = {"p50_us": 50.0, "p99_us": 99.0, "p999_us": 99.9}


@dataclass(frozen=True)
class Latency:
    """Time turns over every transport."""

    bundle: Path = Path("bundles/hard")
    bots: tuple[int, ...] = (1, 16, 64, 256)
    turns: int = 1000  # of each transport and each number of bots
    pin: bool = True  # give the server a core of its own, where there are two
    spin_us: float = 0.0  # how long client and server poll before they sleep
    json: bool = False  # print one JSON line instead of a table


def measure(config: Latency, console: Console) -> dict[str, dict[int, NDArray[np.float64]]]:
    """Whole turn and model time in µs, [turns, 2], by transport and number of bots."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    with ExitStack() as stack:
        engines = Engines(Path(stack.enter_context(TemporaryDirectory()))) if can_build() else None
        c_doors = {} if engines is None else _C_DOORS
        names = ("inproc", *_DOORS, *c_doors)
        times: dict[str, dict[int, NDArray[np.float64]]] = {name: {} for name in names}
        most = str(max(config.bots) * (len(_DOORS) + len(c_doors)))
        served = ("--tcp-port", "0", "--max-bots", most, "--spin-us", str(config.spin_us))
        server = stack.enter_context(ServerProcess(config.bundle, *served))
        addresses = server.addresses()
        if config.pin:
            stack.callback(set_apart([server.pid]))
        progress = stack.enter_context(Progress(console=console))
        task = progress.add_task("turns", total=len(config.bots) * config.turns * len(times))
        for n_bots in config.bots:
            with ExitStack() as clients:
                play = {"inproc": in_process(bundle, golden, n_bots)}
                for name, door in _DOORS.items():
                    client = clients.enter_context(BotClient(addresses[door], spin_us=config.spin_us))
                    play[name] = over(client, bundle, golden, n_bots)
                for name, door in c_doors.items():
                    play[name] = engines.over(addresses[door], golden, n_bots, config.spin_us, clients)
                for name, rows in _rounds(play, config.turns, lambda done: progress.advance(task, done)).items():
                    times[name][n_bots] = np.array(rows)
    return times


def _rounds(play: dict[str, Callable[[], Timed]], turns: int, advance: Callable[[int], None]) -> dict[str, list[Timed]]:
    rows: dict[str, list[Timed]] = {name: [] for name in play}
    for turn in play.values():
        for _ in range(_WARM_UP):
            turn()
    while any(len(done) < turns for done in rows.values()):
        for name, turn in play.items():
            for _ in range(min(_ROUND, turns - len(rows[name]))):
                rows[name].append(turn())
                advance(1)
    return rows


def _table(times: dict[str, dict[int, NDArray[np.float64]]]) -> Table:
    table = Table(title="a turn, µs")
    for name in ("transport", "bots", "p50", "p99", "p99.9", "model p50", "rest p50", "p50 / in process"):
        table.add_column(name, justify="left" if name == "transport" else "right")
    for name, by_bots in times.items():
        for n_bots, rows in by_bots.items():
            quantiles = [f"{np.percentile(rows[:, 0], q):,.0f}" for q in _QUANTILES.values()]
            model, rest = np.median(rows[:, 1]), np.median(rows[:, 0] - rows[:, 1])
            ratio = np.median(rows[:, 0]) / np.median(times["inproc"][n_bots][:, 0])
            table.add_row(name, str(n_bots), *quantiles, f"{model:,.0f}", f"{rest:,.0f}", f"{ratio:.2f}")
    return table


def main() -> None:
    """Command line."""
    config = tyro.cli(Latency, description=__doc__)
    times = measure(config, Console(file=sys.stderr))
    if not config.json:
        Console().print(_table(times))
        return
    line = {
        name: {
            str(n_bots): {key: round(float(np.percentile(rows[:, 0], q)), 1) for key, q in _QUANTILES.items()}
            for n_bots, rows in by_bots.items()
        }
        for name, by_bots in times.items()
    }
    print(json.dumps(line))


if __name__ == "__main__":
    main()
