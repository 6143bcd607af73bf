"""What does a head in the engine save? A frame by two round trips and by one, for 1 to 64 bots, over each transport.

*Two*: `request_queries` and `submit_features`. *One*: the head's own query, which counts, and `take_turn` with the
hidden state in its reply. Both play the same recorded frames with the same seeds, and all their queries are compared.
Rounds visit every way in turn, so that the ratios hold when the machine's speed drifts. The server is its own process;
with two cores or more it has one to itself.

    python -m benchmarks.head --json
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.cores import set_apart
from benchmarks.recorded import RecordedFrames
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from bot_runtime.head import Head
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["HeadInEngine", "Times", "main", "measure"]

_DOORS = ("unix", "tcp", "http")
_WARM_UP = 20
_ROUND = 25  # frames of one way before the next has its turn


@dataclass(frozen=True)
class HeadInEngine:
    """Time frames by two round trips and by one."""

    bundle: Path = Path("bundles/hard")
    bots: tuple[int, ...] = (1, 16, 64)
    turns: int = 500  # of each way
    pin: bool = True  # give the server a core of its own, where there are two
    json: bool = False  # print one JSON line instead of a table


class Times(NamedTuple):
    """µs of whole frames by two round trips and by one, and of the head in the latter, [turns] each; how many frames'
    queries differed."""

    two_us: NDArray[np.float64]
    one_us: NDArray[np.float64]
    head_us: NDArray[np.float64]
    different: int


class _Frame(NamedTuple):
    whole_us: float
    head_us: float
    query: bytes


def _two(client: BotClient, recorded: RecordedFrames, n_bots: int) -> Callable[[int], _Frame]:
    client.hello()
    bots = client.start(n_bots, seeds=range(n_bots))

    def play(frame: int) -> _Frame:
        free = recorded.free(frame)
        begun = time.perf_counter_ns()
        query = client.query(bots, frame, free).queries
        asked = time.perf_counter_ns()
        known = recorded.known(frame, query)
        acquired = time.perf_counter_ns()
        client.act(bots, frame, query, known)
        return _Frame((time.perf_counter_ns() - acquired + asked - begun) / 1e3, 0.0, query.tobytes())

    return play


def _one(client: BotClient, bundle: Bundle, recorded: RecordedFrames, n_bots: int) -> Callable[[int], _Frame]:
    client.hello()
    bots = client.start(n_bots, seeds=range(n_bots))
    head = Head(bundle.manifest, bundle.acquisition, range(n_bots))

    def play(frame: int) -> _Frame:
        free = recorded.free(frame)
        begun = time.perf_counter_ns()
        query = head.ask(frame, free).query_NM
        asked = time.perf_counter_ns()
        known = recorded.known(frame, query)
        acquired = time.perf_counter_ns()
        actions = client.take(bots, frame, free, query, known)
        answered = time.perf_counter_ns()
        head.keep(actions.hidden, actions.turns)
        kept = time.perf_counter_ns()
        return _Frame((kept - acquired + asked - begun) / 1e3, (kept - answered + asked - begun) / 1e3, query.tobytes())

    return play


def measure(config: HeadInEngine, console: Console) -> dict[str, dict[int, Times]]:
    """Times by transport and number of bots."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    times: dict[str, dict[int, Times]] = {door: {} for door in _DOORS}
    with ExitStack() as stack:
        most = str(max(config.bots) * len(_DOORS) * 2)
        server = stack.enter_context(ServerProcess(config.bundle, "--tcp-port", "0", "--max-bots", most))
        addresses = server.addresses()
        if config.pin:
            stack.callback(set_apart([server.pid]))
        progress = stack.enter_context(Progress(console=console))
        task = progress.add_task("frames", total=2 * len(config.bots) * config.turns * len(_DOORS))
        for n_bots in config.bots:
            recorded = RecordedFrames(bundle.manifest.features, golden, n_bots)
            with ExitStack() as clients:
                ways = {}
                for door in _DOORS:
                    two, one = (clients.enter_context(BotClient(addresses[door])) for _ in range(2))
                    ways[door, 2] = _two(two, recorded, n_bots)
                    ways[door, 1] = _one(one, bundle, recorded, n_bots)
                played = _rounds(ways, config.turns, lambda done: progress.advance(task, done))
            for door in _DOORS:
                times[door][n_bots] = _compared(played[door, 2], played[door, 1])
    return times


def _rounds(
    ways: dict[tuple[str, int], Callable[[int], _Frame]], turns: int, advance: Callable[[int], None]
) -> dict[tuple[str, int], list[_Frame]]:
    played: dict[tuple[str, int], list[_Frame]] = {way: [] for way in ways}
    for begun in range(0, turns + _WARM_UP, _ROUND):
        for way, play in ways.items():
            for frame in range(begun, min(begun + _ROUND, turns + _WARM_UP)):
                played[way].append(play(frame))
            advance(_ROUND)
    return played


def _compared(two: list[_Frame], one: list[_Frame]) -> Times:
    return Times(
        np.array([frame.whole_us for frame in two[_WARM_UP:]]),
        np.array([frame.whole_us for frame in one[_WARM_UP:]]),
        np.array([frame.head_us for frame in one[_WARM_UP:]]),
        sum(left.query != right.query for left, right in zip(two, one, strict=True)),
    )


def _row(times: Times) -> dict[str, float]:
    two, one = (float(np.median(us)) for us in (times.two_us, times.one_us))
    return {
        "two_p50_us": round(two, 1),
        "one_p50_us": round(one, 1),
        "two_p99_us": round(float(np.percentile(times.two_us, 99)), 1),
        "one_p99_us": round(float(np.percentile(times.one_us, 99)), 1),
        "head_p50_us": round(float(np.median(times.head_us)), 1),
        "one_of_two": round(one / two, 3),
        "different_queries": times.different,
    }


def main() -> None:
    """Command line."""
    config = tyro.cli(HeadInEngine, description=__doc__)
    times = measure(config, Console(file=sys.stderr))
    rows = {door: {str(n): _row(each) for n, each in by_bots.items()} for door, by_bots in times.items()}
    if config.json:
        print(json.dumps(rows))
        return
    table = Table(title="a frame by two round trips and by one, µs")
    for name in ("transport", "bots", "two p50", "one p50", "two p99", "one p99", "head p50", "one / two", "different"):
        table.add_column(name, justify="left" if name == "transport" else "right")
    for door, by_bots in rows.items():
        for n_bots, row in by_bots.items():
            table.add_row(door, n_bots, *(f"{number:,g}" for number in row.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
