"""Engines that come and go in every way there is: politely, abruptly, silently, with requests that must be refused.

This module knows nothing about what becomes of the server meanwhile.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections import Counter
from contextlib import suppress
from random import Random
from urllib.parse import urlsplit

from benchmarks.recorded import RecordedFrames
from bot_runtime.golden import Golden
from protocol.client import BotClient
from protocol.errors import ProtocolError
from protocol.features import FeatureTable

__all__ = ["Churn"]

_MAX_BOTS = 6  # of one engine
_MAX_FRAMES = 12
_PATIENCE_S = 10.0
_REFUSED: list[dict[str, object]] = [
    {"type": "request_queries", "frame": 0, "bots": [1], "free": b""},
    {"type": "request_queries", "frame": -1, "bots": [1], "free": b""},
    {"type": "submit_features", "frame": 1, "bots": [2**62], "acquired": b"", "values": b"", "surprise": [[]] * 50},
    {"type": "start_bots", "count": 65536},
    {"type": "stop_bots", "bots": []},
]


class Churn:
    """Engines, one after the other in each of some threads, for as long as the `with` block lasts.

    `done` counts what they did; `failed` holds what should not have happened.
    """

    def __init__(self, addresses: dict[str, str], table: FeatureTable, golden: Golden, threads: int, seed: int) -> None:
        self.done: Counter[str] = Counter()
        self.failed: list[Exception] = []
        self._addresses, self._table, self._golden = addresses, table, golden
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._come_and_go, args=(Random(seed + n),)) for n in range(threads)]

    def __enter__(self) -> Churn:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _come_and_go(self, random: Random) -> None:
        while not self._stop.is_set():
            door = random.choice(sorted(self._addresses))
            try:
                self._live(_Engine(self._addresses[door]), random)
                self.done[f"{door} engines"] += 1
                if random.random() < 0.3:
                    _half_a_message(self._addresses[door])
            except ProtocolError as error:  # no room: others are here as well
                self.done[error.code] += 1
                time.sleep(0.05)
            except Exception as error:
                self.failed.append(error)
                return

    def _live(self, client: _Engine, random: Random) -> None:
        """One engine's life, to its end of one kind or another."""
        leave = random.choice((client.close, client.vanish))
        try:
            client.hello()
            bots = client.start(random.randint(1, _MAX_BOTS))
            frames = RecordedFrames(self._table, self._golden, len(bots))
            for frame in range(random.randint(1, _MAX_FRAMES)):
                queries = client.query(bots, frame, frames.free(frame)).queries
                if random.random() < 0.2:
                    self._refused(client, random.choice(_REFUSED))
                if random.random() < 0.1:
                    continue  # this frame is abandoned
                for _ in range(random.choice((1, 1, 1, 2))):
                    client.act(bots, frame, queries, frames.costly(frame))
                self.done["turns"] += 1
            if len(bots) > 1 and random.random() < 0.3:
                client.stop(bots[: len(bots) // 2])
            self.done[leave.__name__] += 1
        finally:
            leave()

    def _refused(self, client: BotClient, message: dict[str, object]) -> None:
        with suppress(ProtocolError):
            client.exchange(dict(message))
            raise AssertionError(f"{message} was accepted")
        self.done["refused"] += 1


class _Engine(BotClient):
    """A client that can end as a crashed process ends."""

    def vanish(self) -> None:
        """The socket closes without a word; over HTTP the connection stays until it has been silent for too long."""
        self._transport.close()


def _half_a_message(address: str) -> None:
    """A socket that is reset in the middle of what it says."""
    parts = urlsplit(address)
    family, where = (
        (socket.AF_UNIX, parts.path)
        if parts.scheme == "unix"
        else (socket.AF_INET, (str(parts.hostname), int(str(parts.port))))
    )
    with socket.socket(family, socket.SOCK_STREAM) as half:
        half.settimeout(_PATIENCE_S)
        half.connect(where)
        half.sendall(b"POST /v1/query HTTP/1.1\r\nHo" if parts.scheme in ("http", "ws") else b"\0\0\1\0\x83")
        half.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
