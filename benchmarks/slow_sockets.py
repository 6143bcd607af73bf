"""Are slow clients closed in time, and does anybody else notice them?

Opens slow sockets to one door after the other (`benchmarks.slow_clients`: silent, a byte a second of a header or of a
body, never reading) while a client plays turns over the Unix socket. *Other bots' p99* is that of the client's turns
while they are open, over that of the same round's turns before and after: the median of the rounds, as machines change
their speed. The slow sockets stand for other machines; their process gives way to the server's and the client's.

    python -m benchmarks.slow_sockets --json
"""

from __future__ import annotations

import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.recorded import Timed, over
from benchmarks.slow_clients import BOTS, KINDS, Held, hold
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Door", "SlowSockets", "main", "measure", "passed"]

_WARM_UP = 50


@dataclass(frozen=True)
class SlowSockets:
    """Open slow sockets to each door."""

    bundle: Path = Path("bundles/hard")
    sockets: int = 500  # to each door
    bots: int = 8  # of the client that plays meanwhile
    quiet_s: float = 2.5  # how long it plays alone, before and after
    rounds: int = 5  # at each door, quiet and with slow sockets in turn
    deadline_s: float = 2.0  # the server's, from when it has let a socket in
    most_s: float = 3.0  # within which it is to have closed each, from connecting or from when it last got on
    patience_s: float = 30.0  # how much longer than the deadline is waited for what is not closed
    most_p99: float = 1.5  # times that without them
    json: bool = False  # print one JSON line instead of a table


@dataclass(frozen=True)
class Door:
    """What was found at one door; times in seconds, `None` where a socket was still open when waiting ended."""

    sockets: int
    slowest_s: dict[str, float | None]  # by kind
    late: int  # sockets that were not closed in time
    quiet_p99_us: float  # medians of the rounds, as are all that follow
    p99_us: float
    p99_ratio: float  # the other bots' p99 over that without slow sockets


def measure(config: SlowSockets) -> dict[str, Door]:
    """Every door in turn, against a server of one's own."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    arguments = ["--tcp-port", "0", "--max-connections", str(config.sockets + 16)]
    arguments += ["--max-bots", str(config.bots + 2 * BOTS), "--frame-deadline-s", str(config.deadline_s)]
    context = multiprocessing.get_context("spawn")
    with ServerProcess(config.bundle, *arguments) as server, ProcessPoolExecutor(1, context, _give_way) as aside:
        addresses = server.addresses()
        with BotClient(addresses["unix"]) as client:
            turn = over(client, bundle, golden, config.bots)
            aside.submit(hold, addresses["tcp"], 1, 0.0).result()  # its process has started
            for _ in range(_WARM_UP):
                turn()
            doors = {}
            for name, address in addresses.items():
                rounds = []
                for _ in range(config.rounds):
                    before = _turns(turn, _for(config.quiet_s))
                    holding = aside.submit(hold, address, config.sockets, config.deadline_s + config.patience_s)
                    meanwhile = _turns(turn, _until(holding))
                    after = _turns(turn, _for(config.quiet_s))
                    rounds.append(_Round(holding.result(), before + after, meanwhile))
                doors[name] = _door(config, rounds)
    return doors


class _Round(NamedTuple):
    """What became of the slow sockets, and µs of the other bots' turns without and with them."""

    held: list[Held]
    quiet_us: list[float]
    us: list[float]


def _give_way() -> None:
    """Run when nobody else wants to, whatever priority this was started with."""
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    else:
        os.nice(19)


def _for(seconds: float) -> Callable[[], bool]:
    end_s = time.monotonic() + seconds
    return lambda: time.monotonic() >= end_s


def _until(holding: Future[list[Held]]) -> Callable[[], bool]:
    return holding.done


def _turns(turn: Callable[[], Timed], over_yet: Callable[[], bool]) -> list[float]:
    """µs of each turn until it is over."""
    whole_us = []
    while not over_yet():
        whole_us.append(turn()[0])
    return whole_us


def _door(config: SlowSockets, rounds: list[_Round]) -> Door:
    held = [each for one in rounds for each in one.held]
    slowest = {}
    for kind in KINDS:
        open_s = [each.open_s for each in held if each.kind == kind]
        slowest[kind] = None if None in open_s else max((s for s in open_s if s is not None), default=0.0)
    late = sum(each.open_s is None or each.open_s > config.most_s for each in held)
    p99_us = np.array([(np.percentile(one.quiet_us, 99), np.percentile(one.us, 99)) for one in rounds])
    medians = np.median(np.column_stack([p99_us, p99_us[:, 1] / p99_us[:, 0]]), axis=0).tolist()
    return Door(len(held), slowest, late, *medians)


def passed(config: SlowSockets, doors: dict[str, Door]) -> bool:
    """Whether every socket was closed in time and no door's slow sockets slowed others more than allowed."""
    return all(door.late == 0 and door.p99_ratio <= config.most_p99 for door in doors.values())


def _table(doors: dict[str, Door]) -> Table:
    table = Table(title="slow sockets: seconds until closed, and other bots' turns")
    for name in ("door", "sockets", *KINDS, "late", "p99 without, µs", "p99, µs", "ratio"):
        table.add_column(name, justify="left" if name == "door" else "right")
    for name, door in doors.items():
        seconds = ["never" if s is None else f"{s:.2f}" for s in door.slowest_s.values()]
        us = f"{door.quiet_p99_us:,.0f}", f"{door.p99_us:,.0f}", f"{door.p99_ratio:.2f}"
        table.add_row(name, str(door.sockets), *seconds, str(door.late), *us)
    return table


def _line(door: Door) -> dict[str, Any]:
    slowest = {kind: None if s is None else round(s, 2) for kind, s in door.slowest_s.items()}
    line = {"sockets": door.sockets, "slowest_s": slowest, "late": door.late}
    line |= {"quiet_p99_us": round(door.quiet_p99_us, 1), "p99_us": round(door.p99_us, 1)}
    return line | {"p99_ratio": round(door.p99_ratio, 2)}


def main() -> None:
    """Command line; ends with 1 unless all were closed in time and nobody else was slowed."""
    config = tyro.cli(SlowSockets, description=__doc__)
    doors = measure(config)
    done = passed(config, doors)
    if config.json:
        print(json.dumps({**{name: _line(door) for name, door in doors.items()}, "passed": done}))
    else:
        Console().print(_table(doors))
    sys.exit(not done)


if __name__ == "__main__":
    main()
