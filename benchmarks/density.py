"""How many bots does one server process on one core carry at 60 Hz?

The server is pinned to one core; an open-loop generator (`benchmarks.open_loop`) on another plays a few engines that
share the bots, every frame when it is due and never later because an answer was late. The largest number of bots for
which the 99th percentile of the whole frame, both round trips, stays within it is searched for: doubled until it no
longer does, then halved in between. A number counts as carried if one of `attempts` runs carries it, since others may
be using the machine.

With `--processes 1 2` as many servers stand behind HAProxy (`benchmarks.front`) instead, on TCP, which shows how bots
grow with processes: it takes a core for each, one for the generator, and some of one for HAProxy.

    python -m benchmarks.density --json
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.cores import set_apart
from benchmarks.front import Front
from benchmarks.open_loop import Load, play_load
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess

__all__ = ["Carried", "Density", "main", "measure", "search"]


@dataclass(frozen=True)
class Density:
    """Search for the largest number of bots at 60 Hz."""

    bundle: Path = Path("bundles/hard")
    int8: Path = Path("bundles/hard-int8")  # its int8 variant; left out where there is no such folder
    door: Literal["unix", "tcp"] = "unix"
    engines: int = 4  # connections that share the bots
    batch_connections: int = 1  # turns of up to so many of them are inferred as one batch
    hz: float = 60.0
    seconds: float = 5.0  # of each run
    attempts: int = 2  # runs that a number of bots has to be carried in one of
    first: int = 64  # bots to begin with
    most: int = 4096  # bots to end with
    step: int = 32  # bots to know it by
    processes: tuple[int, ...] = ()  # servers behind HAProxy, instead of one without
    pin: bool = True  # give each server a core of its own, as far as there are any
    json: bool = False  # print one JSON line instead of a table

    def __post_init__(self) -> None:
        if min(self.engines, self.attempts, self.first, self.step) < 1 or self.first < self.engines:
            raise ValueError("engines, attempts and step must be at least 1, and first as many as engines")


@dataclass(frozen=True)
class Carried:
    """The largest number of bots that was carried (0: not even the first), and the run that did it."""

    bots: int
    load: Load | None


def search(run: Callable[[int], Load], config: Density, tell: Callable[[int, Load, bool], None]) -> Carried:
    """Double the bots until a run is too slow, then halve the gap until it is one step."""
    limit_ms = 1e3 / config.hz

    def carried(bots: int) -> Carried | None:
        for _ in range(config.attempts):
            load = run(bots)
            tell(bots, load, load.ms(99.0) < limit_ms)
            if load.ms(99.0) < limit_ms:
                return Carried(bots, load)
        return None

    best, bots = Carried(0, None), config.first
    while bots <= config.most and (found := carried(bots)):
        best, bots = found, bots * 2
    too_many = min(bots, config.most + 1)
    while too_many - best.bots > config.step and best.bots:
        bots = best.bots + (too_many - best.bots) // 2
        if found := carried(bots):
            best = found
        else:
            too_many = bots
    return best


def measure(path: Path, config: Density, processes: int | None, console: Console) -> Carried:
    """The bots that one bundle's server carries, or so many servers behind HAProxy (None: one without)."""
    bundle = Bundle.load(path)
    golden = read_golden((path / "golden.npz").read_bytes(), bundle.manifest)
    with _served(path, config, processes) as url:

        def run(bots: int) -> Load:
            shares = [bots // config.engines + (engine < bots % config.engines) for engine in range(config.engines)]
            return play_load(url, bundle, golden, shares, config.seconds, config.hz)

        def tell(bots: int, load: Load, carried: bool) -> None:
            server = f"{path.name}, " + ("one server" if processes is None else f"{processes} behind HAProxy")
            console.print(
                f"{server}: {bots} bots {'' if carried else 'not '}carried, p50 {load.ms(50.0):.1f} ms, "
                f"p99 {load.ms(99.0):.1f} ms, generator {100 * load.busy:.0f} % busy"
            )

        return search(run, config, tell)


@contextmanager
def _served(path: Path, config: Density, processes: int | None) -> Iterator[str]:
    """Where to connect to: one server, or HAProxy before several."""
    arguments = ("--tcp-port", "0", "--max-bots", str(config.most), "--max-connections", str(4 * config.engines))
    arguments += ("--batch-connections", str(config.batch_connections))
    with ExitStack() as stack:
        servers = [
            stack.enter_context(ServerProcess(path, *arguments, "--process", f"p{number}"))
            for number in range(1, (processes or 1) + 1)
        ]
        addresses = [server.addresses() for server in servers]
        url = addresses[0][config.door]
        if processes is not None:
            url = stack.enter_context(Front(addresses)).tcp
        if config.pin:
            stack.callback(set_apart([server.pid for server in servers]))
        yield url


def _table(rows: list[tuple[str, str, Carried]]) -> Table:
    table = Table(title=f"bots at 60 Hz (load {os.getloadavg()[0]:.1f})")
    for name in ("bundle", "processes", "bots", "frame p50 ms", "p99 ms", "generator busy"):
        table.add_column(name, justify="left" if name == "bundle" else "right")
    for name, processes, carried in rows:
        told = ["", "", ""]
        if (load := carried.load) is not None:
            told = [f"{load.ms(50.0):.1f}", f"{load.ms(99.0):.1f}", f"{100 * load.busy:.0f} %"]
        table.add_row(name, processes, str(carried.bots), *told)
    return table


def main(config: Density) -> None:
    """Print the table or the JSON line."""
    console = Console(stderr=True)
    bundles = {"fp32": config.bundle, **({"int8": config.int8} if config.int8.is_dir() else {})}
    line: dict[str, object] = {"bots_fp32": None, "bots_int8": None}
    rows = []
    for name, path in bundles.items():
        if not config.processes:
            carried = measure(path, config, None, console)
            rows.append((name, "1", carried))
            line[f"bots_{name}"] = carried.bots
            continue
        by_processes = {count: measure(path, config, count, console) for count in config.processes}
        rows += [(name, f"{count} behind HAProxy", carried) for count, carried in by_processes.items()]
        line[f"bots_{name}"] = {str(count): carried.bots for count, carried in by_processes.items()}
    if config.json:
        print(json.dumps({**line, "load": round(os.getloadavg()[0], 2)}))
    else:
        Console().print(_table(rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Density, description=__doc__)))
