"""Engines that never wait: frames are due by the clock, and a late one counts with all of its lateness.

Each engine is one connection with some bots, in this process and on one thread. A frame is both round trips; it is due
every 1/60 s whether or not the last one is done, and its time runs from when it was due (no coordinated omission: what
a slow answer delays is counted as delayed, not left out). A frame whose predecessor is still out waits its turn.
Messages are packed beforehand, but for the frame's number and the values that were asked for, to leave the machine to
the server.

This module knows nothing about processes or about how many bots are too many.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
from numpy.typing import NDArray

from benchmarks.recorded import RecordedFrames
from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden

__all__ = ["Engine", "Load", "play_load"]

_LENGTH = struct.Struct(">I")
_FRAME = struct.Struct(">BQ")  # msgpack's 64-bit unsigned integer
_UINT64 = 0xCF
_RECORDED = 32  # frames packed beforehand, played over and over
_TIMEOUT_S = 10.0
_FIRST_S = 1.0  # of a run, that does not count
_HOPELESS_S = 1.0  # a frame this late ends the run


@dataclass(frozen=True)
class Load:
    """What came of a run."""

    late_ms: NDArray[np.float64]  # [frames] from when each was due to its actions; infinite where it was given up
    busy: float  # the share of the time in which the generator itself worked, that is, did not wait

    def ms(self, percentile: float) -> float:
        """A percentile of the frames' times."""
        return float(np.percentile(self.late_ms, percentile, method="higher"))


class Engine:
    """One connection: its frames that are due, and the one that is out."""

    def __init__(self, url: str, bundle: Bundle, golden: Golden, n_bots: int) -> None:
        with ExitStack() as opened:
            self.socket = opened.enter_context(_connect(url))
            _exchange(self.socket, {"type": "hello", "protocol": 1})
            bots = _exchange(self.socket, {"type": "start_bots", "count": n_bots})["bots"]
            opened.pop_all()
        table, frames = bundle.manifest.features, RecordedFrames(bundle.manifest.features, golden, n_bots)
        self._owner, self._shape = table.owner, (n_bots, -1)
        self._queries = [
            _packed("request_queries", {"bots": bots, "free": frames.free(frame).tobytes()})
            for frame in range(_RECORDED)
        ]
        self._features = _packed("submit_features", {"bots": bots}, room_for=2)
        self._costly = [frames.costly(frame) for frame in range(_RECORDED)]
        self._n_queries = table.n_queries
        self._frame, self._asking, self._received = 0, False, bytearray()
        self._due_s: deque[float] = deque()
        self.late_ms: list[float] = []

    def is_late(self, now_s: float) -> bool:
        """Whether there is no hope."""
        return bool(self._due_s) and now_s - self._due_s[0] > _HOPELESS_S

    @property
    def n_waiting(self) -> int:
        """Frames that are due and not done, the one that is out among them."""
        return len(self._due_s)

    def due(self, at_s: float) -> None:
        """A frame is due; it leaves now if no other is out."""
        self._due_s.append(at_s)
        if len(self._due_s) == 1:
            self._ask()

    def receive(self) -> None:
        """Read what there is; where that completes a reply, go on."""
        self._received += self.socket.recv(2**20) or _closed()
        if len(self._received) < _LENGTH.size:
            return
        (size,) = _LENGTH.unpack_from(self._received)
        if len(self._received) < _LENGTH.size + size:
            return
        reply = msgpack.unpackb(bytes(self._received[_LENGTH.size :]))
        self._received.clear()
        if reply["type"] == "error":
            raise ConnectionError(f"{reply['code']}: {reply['detail']}")
        if self._asking:
            self._act(reply["queries"])
            return
        self.late_ms.append(1e3 * (time.monotonic() - self._due_s.popleft()))
        self._frame += 1
        if self._due_s:
            self._ask()

    def _ask(self) -> None:
        self._asking = True
        head, tail = self._queries[self._frame % _RECORDED]
        self._send(head, tail)

    def _act(self, queries: bytes) -> None:
        """Everything that was asked for is acquired: the query's bits go back as they came."""
        self._asking = False
        bits = np.frombuffer(queries, dtype=np.uint8).reshape(self._shape)
        query_NM = np.unpackbits(bits, axis=1, count=self._n_queries, bitorder="little").view(np.bool_)
        values = self._costly[self._frame % _RECORDED][query_NM[:, self._owner]].tobytes()
        head, tail = self._features
        self._send(head, tail + _pairs({"acquired": queries, "values": values}))

    def _send(self, head: bytes, tail: bytes) -> None:
        body = head + _FRAME.pack(_UINT64, self._frame) + tail
        self.socket.sendall(_LENGTH.pack(len(body)) + body)


def play_load(url: str, bundle: Bundle, golden: Golden, bots: Sequence[int], seconds: float, hz: float) -> Load:
    """One engine for each of `bots`, at a random phase of the frame (seeded), for so long and a second before that does
    not count: in it everything is done for the first time. Raises OSError."""
    with ExitStack() as stack:
        engines = []
        for n_bots in bots:
            engines.append(Engine(url, bundle, golden, n_bots))
            stack.callback(engines[-1].socket.close)
        phases = np.random.default_rng(0).uniform(0.0, 1.0, len(engines))
        n_frames, n_first = round((_FIRST_S + seconds) * hz), round(_FIRST_S * hz)
        begun_s = time.monotonic() + 0.05
        at_s = begun_s + (np.arange(n_frames)[:, None] + phases) / hz  # [frames, engines]
        order = np.argsort(at_s, axis=None)
        due = [(float(at_s.flat[i]), engines[i % len(engines)]) for i in order]
        driven_s = time.monotonic()
        waited_s = _drive(engines, deque(due))
        whole_s = time.monotonic() - driven_s
    late_ms = np.full((len(engines), n_frames), np.inf)
    for row, engine in zip(late_ms, engines, strict=True):
        row[: len(engine.late_ms)] = engine.late_ms
    return Load(late_ms[:, n_first:].ravel(), 1.0 - waited_s / whole_s)


def _drive(engines: list[Engine], due: deque[tuple[float, Engine]]) -> float:
    """Play until every frame is done or one is hopeless; the seconds in which there was nothing to do."""
    waited_s, by_socket = 0.0, {engine.socket: engine for engine in engines}
    while due or any(engine.n_waiting for engine in engines):
        now_s = time.monotonic()
        while due and due[0][0] <= now_s:
            at_s, engine = due.popleft()
            engine.due(at_s)
        if any(engine.is_late(now_s) for engine in engines):
            break
        asleep_s = time.monotonic()
        timeout_s = max(0.0, due[0][0] - asleep_s) if due else _HOPELESS_S
        # select, since it waits by the microsecond and epoll by the millisecond.
        readable, _, _ = select.select(by_socket, [], [], timeout_s)
        waited_s += time.monotonic() - asleep_s
        for ready in readable:
            by_socket[ready].receive()
    return waited_s


def _packed(kind: str, rest: dict[str, Any], room_for: int = 0) -> tuple[bytes, bytes]:
    """A message around its frame number; its map has room for so many more keys, to be appended."""
    n_keys = 2 + len(rest) + room_for
    return bytes([0x80 | n_keys]) + _pairs({"type": kind}) + msgpack.packb("frame"), _pairs(rest)


def _pairs(pairs: dict[str, Any]) -> bytes:
    return b"".join(msgpack.packb(key) + msgpack.packb(value) for key, value in pairs.items())


def _connect(url: str) -> socket.socket:
    parts = urlsplit(url)
    if parts.scheme == "unix":
        connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connected.settimeout(_TIMEOUT_S)
        connected.connect(parts.path)
        return connected
    connected = socket.create_connection((parts.hostname or "", parts.port or 0), timeout=_TIMEOUT_S)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connected


def _exchange(connected: socket.socket, message: dict[str, Any]) -> dict[str, Any]:
    body = msgpack.packb(message)
    connected.sendall(_LENGTH.pack(len(body)) + body)
    with connected.makefile("rb") as replies:
        (size,) = _LENGTH.unpack(replies.read(_LENGTH.size) or _closed())
        reply = msgpack.unpackb(replies.read(size))
    if reply["type"] == "error":
        raise ConnectionError(f"{reply['code']}: {reply['detail']}")
    return reply


def _closed() -> bytes:
    raise ConnectionResetError("the server closed the socket")
