"""What is gained where a client, a server or both stay awake for a while, instead of sleeping until they are woken?

    python -m benchmarks.waking --json

A turn of one bot over a Unix socket (two round trips at once, without what an engine does between them), for every pair
of a client that polls for so many µs before it sleeps and a server that does. Rounds visit them all in turn. *Beyond*
is the median above that of a turn in process. Each process has a core to itself where there are two.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.cores import set_apart
from benchmarks.recorded import Timed, in_process, over
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Waking", "measure"]

_ROUND = 20  # turns of one pair before the next has its turn
_WARM_UP = 30
_QUANTILES = {"p10_us": 10.0, "p50_us": 50.0, "p99_us": 99.0}
_IN_PROCESS = "in process"


@dataclass(frozen=True)
class Waking:
    """Time turns between clients and servers that sleep and that do not."""

    bundle: Path = Path("bundles/hard")
    client_us: tuple[float, ...] = (0.0, 50.0, 200.0, 500.0)
    server_us: tuple[float, ...] = (0.0, 50.0, 200.0, 500.0)
    bots: int = 1
    rounds: int = 20
    json: bool = False  # print one JSON line instead of a table


def measure(options: Waking) -> dict[str, dict[str, float]]:
    """Quantiles of a turn's µs, and what it takes beyond one in process, by `client / server` spin."""
    bundle = Bundle.load(options.bundle)
    golden = read_golden((options.bundle / "golden.npz").read_bytes(), bundle.manifest)
    play: dict[str, Callable[[], Timed]] = {_IN_PROCESS: in_process(bundle, golden, options.bots)}
    with ExitStack() as stack:
        pids = []
        for server_us in options.server_us:
            most = str(options.bots * len(options.client_us))
            spin = ("--max-bots", most, "--spin-us", str(server_us))
            server = stack.enter_context(ServerProcess(options.bundle, *spin))
            address = server.addresses()["unix"]
            pids.append(server.pid)
            for client_us in options.client_us:
                client = stack.enter_context(BotClient(address, spin_us=client_us))
                play[f"{client_us:g} / {server_us:g}"] = over(client, bundle, golden, options.bots)
        for pid in pids:
            stack.callback(set_apart([pid]))
        took: dict[str, list[float]] = {pair: [] for pair in play}
        for turn in play.values():
            for _ in range(_WARM_UP):
                turn()
        for _ in range(options.rounds):
            for pair, turn in play.items():
                took[pair] += [turn()[0] for _ in range(_ROUND)]
    apart_us = float(np.median(took[_IN_PROCESS]))
    return {
        pair: {name: float(np.percentile(times_us, q)) for name, q in _QUANTILES.items()}
        | {"beyond_us": float(np.median(times_us)) - apart_us}
        for pair, times_us in took.items()
    }


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Waking, description=__doc__)
    found = measure(options)
    if options.json:
        print(json.dumps(found))
        return
    print("a turn over a Unix socket, µs; client / server: how long each polls before it sleeps")
    for pair, row in found.items():
        print(f"{pair:12}" + "".join(f"  {name.removesuffix('_us')} {us:7.0f}" for name, us in row.items()))


if __name__ == "__main__":
    main()
