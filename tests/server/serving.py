"""Real servers on loopback, in a thread of the test's process, and the rawest ways to talk to them."""

from __future__ import annotations

import asyncio
import http.client
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack
import numpy as np
import uvloop

from protocol.client import Actions, BotClient
from protocol.features import FeatureTable
from server.app import running
from server.settings import Settings


class Served(NamedTuple):
    addresses: dict[str, str]
    stop: Callable[[], None]


class FakeClock:
    """Seconds that pass only when told."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@contextmanager
def serve(
    bundle: Path | None, uds: Path, clock: Callable[[], float] | None = None, **overrides: Any
) -> Iterator[Served]:
    settings = Settings(bundle=bundle, port=0, tcp_port=0, uds=uds, **overrides)
    started, failure = threading.Event(), []
    found: list[tuple[dict[str, str], asyncio.AbstractEventLoop, asyncio.Event]] = []

    async def main() -> None:
        stop = asyncio.Event()
        async with running(settings, **({} if clock is None else {"clock": clock})) as addresses:
            found.append((addresses, asyncio.get_running_loop(), stop))
            started.set()
            await stop.wait()

    def run() -> None:
        try:
            uvloop.run(main())
        except BaseException as error:
            failure.append(error)
        finally:
            started.set()

    thread = threading.Thread(target=run)
    thread.start()
    started.wait()
    if failure:
        raise failure[0]
    addresses, loop, stop = found[0]

    def end() -> None:
        if thread.is_alive():
            loop.call_soon_threadsafe(stop.set)
            thread.join()

    try:
        yield Served(addresses, end)
    finally:
        end()
    if failure:
        raise failure[0]


class HttpAnswer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes


def http_request(
    address: str,
    method: str,
    path: str,
    body: Any = None,
    headers: dict[str, str] | None = None,
    *,
    timeout_s: float = 10.0,
) -> HttpAnswer:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=timeout_s)
    try:
        connection.request(method, path, body, headers or {})
        with connection.getresponse() as response:
            lowered = {name.lower(): value for name, value in response.getheaders()}
            return HttpAnswer(response.status, lowered, response.read())
    finally:
        connection.close()


class RawStream:
    """A socket to a stream door and no manners."""

    def __init__(self, address: str) -> None:
        parts = urlsplit(address)
        if parts.scheme == "unix":
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.settimeout(10)
            self.socket.connect(parts.path)
        else:
            self.socket = socket.create_connection((str(parts.hostname), int(str(parts.port))), timeout=10)
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> RawStream:
        return self

    def __exit__(self, *_: object) -> None:
        """Close, and wait until the server has: what it does afterwards then comes after the end of this connection."""
        with self.socket, suppress(OSError):
            self.socket.shutdown(socket.SHUT_WR)
            while self.socket.recv(65536):
                pass

    def frame(self, body: bytes) -> dict[str, Any]:
        self.socket.sendall(struct.pack(">I", len(body)) + body)
        return self.reply()

    def reply(self) -> dict[str, Any]:
        (size,) = struct.unpack(">I", self._exactly(4))
        return dict(msgpack.unpackb(self._exactly(size)))

    def ended(self) -> bool:
        """Whether the server closes the socket without another word."""
        try:
            return self.socket.recv(1) == b""
        except ConnectionResetError:
            return True

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            part = self.socket.recv(size - len(data))
            if not part:
                raise ConnectionResetError("closed")
            data += part
        return data


def free_numbers(table: FeatureTable, n: int, seed: int) -> np.ndarray:
    low, high = table.free_range
    return np.random.default_rng(seed).uniform(low, high, (n, table.n_free)).astype(np.float32)


def costly_numbers(table: FeatureTable, n: int, seed: int) -> np.ndarray:
    low, high = table.costly_range
    return np.random.default_rng(seed + 10**6).uniform(low, high, (n, table.n_costly)).astype(np.float32)


def play(client: BotClient, table: FeatureTable, bots: np.ndarray, frames: range) -> list[Actions]:
    """Whole turns on inputs that depend on the frame alone."""
    n, played = len(bots), []
    for frame in frames:
        queries = client.query(bots, frame, free_numbers(table, n, frame), np.full(n, 0.25))
        played.append(client.act(bots, frame, queries.queries, costly_numbers(table, n, frame)))
    return played


def same(left: list[Actions], right: list[Actions]) -> bool:
    pairs = zip(left, right, strict=True)
    return all(np.array_equal(a.actions, b.actions) and np.array_equal(a.reasons, b.reasons) for a, b in pairs)
