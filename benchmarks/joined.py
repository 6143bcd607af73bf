"""What do a socket's two ends take by themselves? A client and a server in one thread, without the socket between them.

    python -m benchmarks.joined [--json]

What the client sends goes straight into the server's conversation, and its replies straight back: all that a turn over
a Unix socket runs in Python but for the kernel, the event loop and the second process. *Beyond* is what that takes on
top of a turn in process. It is processor time of the one thread, so that other processes' share of the machine hardly
counts. Rounds visit both in turn; of their means, the least and the median are shown.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.recorded import Timed, in_process, over
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from protocol.client import BotClient
from protocol.transport import StreamTransport
from server.connections import Connections
from server.desk import Desk
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from server.sockets import Sockets
from server.stream import StreamSocket

__all__ = ["Joined", "measure"]

_ROUND = 20  # turns of one before the other has its own
_WARM_UP = 100
_PATIENCE_S = 3600.0


@dataclass(frozen=True)
class Joined:
    """Time both ends of a socket in one thread."""

    bundle: Path = Path("bundles/hard")
    bots: tuple[int, ...] = (1, 16)
    rounds: int = 200
    json: bool = False  # print one JSON line instead of a table


class _AtOnce:
    """A worker that is always idle: a hello too is answered before it returns."""

    is_idle = True
    backlog_us = 0.0

    def run(self, job: Callable[[], Any], expected_us: float = 0.0) -> Any:
        return job()

    def post(self, job: Callable[[], object]) -> None:
        job()


class _Free:
    """Looks at sockets that there are none of: every turn has its own."""

    is_free, backlog_us = True, 0.0

    def take(self) -> None:
        pass

    def since_ns(self, received_ns: int) -> int:
        return received_ns


class _Pipe:
    """The client's socket and the server's transport in one."""

    def __init__(self, conversation: StreamSocket) -> None:
        self._conversation, self._reply = conversation, b""
        conversation.connection_made(self)

    def sendall(self, data: bytes) -> None:
        self._conversation.data_received(data)

    def recv(self, size: int) -> bytes:
        return self._reply

    def write(self, data: bytes) -> None:
        self._reply = data

    def set_write_buffer_limits(self, high: int) -> None:
        pass

    def close(self) -> None:
        pass


def measure(options: Joined) -> dict[str, dict[int, tuple[float, float]]]:
    """Least and median µs of a turn `in process`, `joined`, and `beyond`, by number of bots."""
    bundle = Bundle.load(options.bundle)
    golden = read_golden((options.bundle / "golden.npz").read_bytes(), bundle.manifest)
    found: dict[str, dict[int, tuple[float, float]]] = {"in process": {}, "joined": {}, "beyond": {}}
    for n_bots in options.bots:
        with asyncio.Runner() as runner, ExitStack() as stack:
            client = stack.enter_context(runner.run(_client(bundle, n_bots)))
            apart = in_process(bundle, golden, n_bots, "cpu")
            joined = over(client, bundle, golden, n_bots, "cpu")
            for turn in (apart, joined):
                _mean_us(turn, _WARM_UP)
            means_us = np.array([(_mean_us(apart), _mean_us(joined)) for _ in range(options.rounds)])
        columns = np.column_stack([means_us, means_us[:, 1] - means_us[:, 0]])
        least_us, median_us = columns.min(axis=0), np.median(columns, axis=0)
        least_us[2] = least_us[1] - least_us[0]  # the least difference would be of two rounds that had other luck
        for name, least, median in zip(found, least_us.tolist(), median_us.tolist(), strict=True):
            found[name][n_bots] = least, median
    return found


async def _client(bundle: Bundle, n_bots: int) -> BotClient:
    """A client joined to a server of its own. A conversation begins where an event loop runs, and needs it no more."""
    servings = Servings(n_bots)
    servings.activate(Serving(bundle, max_bots=n_bots))
    handlers = Handlers(servings, Connections(1, _PATIENCE_S), None)
    desk = Desk(handlers, _AtOnce(), inline_us=float("inf"), looks=_Free())
    sockets = Sockets(desk, max_sockets=1, frame_deadline_s=_PATIENCE_S, idle_ttl_s=_PATIENCE_S)
    client = BotClient("unix:///joined")
    client._transport = StreamTransport(partial(_Pipe, StreamSocket(sockets, "unix")))
    return client


def _mean_us(turn: Callable[[], Timed], turns: int = _ROUND) -> float:
    return sum(turn()[0] for _ in range(turns)) / turns


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Joined, description=__doc__)
    found = measure(options)
    if options.json:
        print(json.dumps({name: {str(n): pair for n, pair in rows.items()} for name, rows in found.items()}))
        return
    print("processor time of a turn, µs: least of a round's means, and median")
    for name, rows in found.items():
        print(f"{name:12}" + "".join(f"{n:5} bots {least:7.1f} {median:7.1f}" for n, (least, median) in rows.items()))


if __name__ == "__main__":
    main()
