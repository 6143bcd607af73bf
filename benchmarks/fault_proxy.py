"""A line that loses, repeats, reorders, delays and cuts messages: between an HTTP client on this machine and a server.

This module knows nothing about what the messages say. TCP itself neither loses nor reorders, so a lost message is one
that is swallowed with its connection, and a late one is delivered after messages that were sent after it. Only turns
are treated so (`/v1/query`, `/v1/act`): those may be retried, whatever became of them.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from random import Random
from typing import NamedTuple
from urllib.parse import urlsplit

__all__ = ["FaultProxy", "Faults"]

_TURNS = (b"POST /v1/query ", b"POST /v1/act ")
_MAX_OVERTAKEN = 6  # messages that may overtake a late one
_PATIENCE_S = 10.0


@dataclass(frozen=True)
class Faults:
    """What becomes of a turn's message: the share of them that each fault befalls, one at most."""

    loss: float = 0.2  # half of them on the way there, half on the way back; half of each cut at some byte
    duplicates: float = 0.05  # delivered twice
    reordered: float = 0.05  # delivered only after later ones
    delay_s: float = 0.0  # every message waits up to so long

    def __post_init__(self) -> None:
        if not 0.0 <= self.loss + self.duplicates + self.reordered < 1.0:
            raise ValueError("loss, duplicates and reordered are shares of the messages, together less than 1")


class _Late(NamedTuple):
    """A message that waits until so many more have passed."""

    message: bytes
    overtaken_by: int


class FaultProxy:
    """Listens on loopback in a thread of its own, for as long as the `with` block of `listening` lasts.

    `befell` counts the messages by what became of them.
    """

    def __init__(self, upstream: str, faults: Faults, seed: int) -> None:
        """`upstream` is the server's `http://host:port`."""
        parts = urlsplit(upstream)
        self._host, self._port = str(parts.hostname), int(str(parts.port))
        self._faults, self._random = faults, Random(seed)
        self._late: list[_Late] = []
        self._deliveries: set[asyncio.Task[bytes]] = set()
        self.befell: Counter[str] = Counter()

    @contextmanager
    def listening(self) -> Iterator[str]:
        """The proxy's own `http://host:port`."""
        started, found = threading.Event(), []

        async def main() -> None:
            stop = asyncio.Event()
            server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
            found.append((server.sockets[0].getsockname()[1], asyncio.get_running_loop(), stop))
            started.set()
            await stop.wait()
            server.close()
            await asyncio.gather(*self._deliveries, return_exceptions=True)

        thread = threading.Thread(target=asyncio.run, args=(main(),), name="faults")
        thread.start()
        started.wait()
        port, loop, stop = found[0]
        try:
            yield f"http://127.0.0.1:{port}"
        finally:
            loop.call_soon_threadsafe(stop.set)
            thread.join()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client's connection, until it is cut or the client closes it."""
        upstream: _Upstream | None = None
        with suppress(OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
            upstream = await _Upstream.open(self._host, self._port)
            while await self._pass(await _message(reader), upstream, writer):
                pass
        writer.transport.abort() if writer.transport.get_write_buffer_size() else writer.close()
        if upstream is not None:
            upstream.close()

    async def _pass(self, message: bytes, upstream: _Upstream, writer: asyncio.StreamWriter) -> bool:
        """Whether the connection goes on after this message."""
        fault = self._drawn() if message.startswith(_TURNS) else "passed"
        self.befell[fault] += 1
        if self._faults.delay_s:
            await asyncio.sleep(self._random.uniform(0.0, self._faults.delay_s))
        self._deliver_late()
        match fault:
            case "request lost":
                return False
            case "request cut":
                await upstream.send(message[: self._random.randrange(1, len(message))])
                return False
            case "reordered":
                self._late.append(_Late(message, self._random.randint(1, _MAX_OVERTAKEN)))
                return False
            case "duplicated":
                self._deliver(message)
        reply = await upstream.exchange(message)
        match fault:
            case "reply lost":
                return False
            case "reply cut":
                writer.write(reply[: self._random.randrange(1, len(reply))])
                await writer.drain()
                return False
        writer.write(reply)
        await writer.drain()
        return True

    def _drawn(self) -> str:
        faults, share = self._faults, self._random.random()
        if share < faults.loss:
            return self._random.choice(("request lost", "request cut", "reply lost", "reply cut"))
        if share < faults.loss + faults.duplicates:
            return "duplicated"
        return "reordered" if share < faults.loss + faults.duplicates + faults.reordered else "passed"

    def _deliver_late(self) -> None:
        """One more message has passed those that wait."""
        waiting = [late._replace(overtaken_by=late.overtaken_by - 1) for late in self._late]
        self._late = [late for late in waiting if late.overtaken_by > 0]
        for late in waiting:
            if late.overtaken_by <= 0:
                self._deliver(late.message)

    def _deliver(self, message: bytes) -> None:
        """Beside the connection that it came by; nobody reads the answer."""
        delivery = asyncio.create_task(self._aside(message))
        self._deliveries.add(delivery)
        delivery.add_done_callback(self._deliveries.discard)

    async def _aside(self, message: bytes) -> bytes:
        upstream = await _Upstream.open(self._host, self._port)
        try:
            return await upstream.exchange(message)
        finally:
            upstream.close()


class _Upstream:
    """A connection to the server."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    @classmethod
    async def open(cls, host: str, port: int) -> _Upstream:
        return cls(*await asyncio.open_connection(host, port))

    async def send(self, part: bytes) -> None:
        self._writer.write(part)
        await self._writer.drain()

    async def exchange(self, message: bytes) -> bytes:
        async with asyncio.timeout(_PATIENCE_S):
            await self.send(message)
            return await _message(self._reader)

    def close(self) -> None:
        self._writer.close()


async def _message(reader: asyncio.StreamReader) -> bytes:
    """One HTTP/1.1 message, a request or an answer, that says how long its body is."""
    head = await reader.readuntil(b"\r\n\r\n")
    for line in head.lower().split(b"\r\n"):
        if line.startswith(b"content-length:"):
            return head + await reader.readexactly(int(line.partition(b":")[2]))
    return head
