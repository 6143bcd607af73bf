"""Engines that are offered frames: at random instants, each to one that is free, or as fast as a server answers them.

A frame is a query and, once that is answered, its features, each with a deadline. All engines live on one thread of
this process. This module knows nothing about loads, or about what is good enough.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections import Counter
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack
import numpy as np

from benchmarks.recorded import RecordedFrames
from bot_runtime.bundle import Bundle
from bot_runtime.fallback import Reason
from bot_runtime.golden import Golden

__all__ = ["Answered", "Engine", "Phase", "capacity_hz", "offer"]

_LENGTH = struct.Struct(">I")
_TIMEOUT_S = 10.0
_LOOK_S = 0.05
_FEW = 4  # frames that are out at once while capacity is measured: the server never waits for an engine


class Answered(NamedTuple):
    """One request: when its answer came, how long it took, what kind of answer, and why it was no better."""

    at_s: float
    ms: float
    kind: str  # `learned`, `fallback`, `refused`
    late: bool  # as the server says
    is_whole: bool  # it ends a frame
    cause: str = ""  # of a fallback: its commonest reason, as in `bot_runtime.fallback`


class Phase(NamedTuple):
    """A load: how many frames came, how many of them found no engine free, and every request of the others.

    `sent_late_ms` is how long after their instant frames were sent: what the engines' own process has delayed.
    """

    frames: int
    unsent: int
    answers: list[Answered]
    begun_s: float
    sent_late_ms: list[float]


class Engine:
    """One connection over a Unix socket, at most one request out."""

    def __init__(self, url: str, bundle: Bundle, golden: Golden, n_bots: int, deadline_us: float) -> None:
        self.socket = _connect(url)
        self._frames = RecordedFrames(bundle.manifest.features, golden, n_bots)
        self._owner, self._deadline_us, self._n_bots = bundle.manifest.features.owner, deadline_us, n_bots
        self.answers: list[Answered] = []
        self.is_free, self._frame, self._received = True, 0, bytearray()
        self._send({"type": "hello", "protocol": 1})
        self._reply()
        self._send({"type": "start_bots", "count": n_bots})
        self._bots = self._reply()["bots"]

    def begin(self) -> None:
        """Send a frame's query."""
        self._frame += 1
        self.is_free = False
        self._send({**self._head("request_queries"), "free": self._frames.free(self._frame).tobytes()})

    def receive(self) -> None:
        """Read what there is; where that completes a reply, go on with the frame."""
        self._received += self.socket.recv(2**20)
        if len(self._received) < 4 or len(self._received) < 4 + _LENGTH.unpack_from(self._received)[0]:
            return
        now_s = time.monotonic()
        reply = msgpack.unpackb(bytes(self._received[4:]))
        self._received.clear()
        self.answers.append(_answered(reply, now_s, self._sent_s))
        if reply["type"] != "queries":
            self.is_free = True
            return
        bits_NB = np.frombuffer(reply["queries"], dtype=np.uint8).reshape(self._n_bots, -1)
        query_NM = np.unpackbits(bits_NB, axis=1, count=int(self._owner.max()) + 1, bitorder="little").view(np.bool_)
        values = self._frames.costly(self._frame)[query_NM[:, self._owner]].tobytes()
        self._send({**self._head("submit_features"), "acquired": reply["queries"], "values": values})

    def _head(self, kind: str) -> dict[str, Any]:
        return {"type": kind, "frame": self._frame, "bots": self._bots, "deadline_us": self._deadline_us}

    def _send(self, message: dict[str, Any]) -> None:
        body = msgpack.packb(message)
        self._sent_s = time.monotonic()
        self.socket.sendall(_LENGTH.pack(len(body)) + body)

    def _reply(self) -> dict[str, Any]:
        with self.socket.makefile("rb") as replies:
            (size,) = _LENGTH.unpack(replies.read(4))
            return dict(msgpack.unpackb(replies.read(size)))


def capacity_hz(engines: list[Engine], seconds: float) -> float:
    """Frames a second where the next begins as soon as few are out."""
    begun_s, frames = time.monotonic(), 0
    while (now_s := time.monotonic()) < begun_s + seconds:
        for engine in [each for each in engines if each.is_free][: max(0, _FEW - _n_out(engines))]:
            _begin(engines, engine)
            frames += 1
        _receive(engines, _LOOK_S)
    spent_s = now_s - begun_s
    _drain(engines)
    return frames / spent_s


def offer(engines: list[Engine], rate_hz: float, seconds: float, seed: int) -> Phase:
    """Frames at random instants (Poisson, seeded), each to the engine that has been free for longest."""
    random, begun_s = np.random.default_rng(seed), time.monotonic()
    for engine in engines:
        engine.answers = []
    frames, unsent, sent_late_ms = 0, 0, []
    due_s = begun_s + random.exponential(1.0 / rate_hz)
    while (now_s := time.monotonic()) < begun_s + seconds:
        while due_s <= now_s:
            free = next((engine for engine in engines if engine.is_free), None)
            frames, unsent = frames + 1, unsent + (free is None)
            if free is not None:
                sent_late_ms.append(1e3 * (time.monotonic() - due_s))
                _begin(engines, free)
            due_s += random.exponential(1.0 / rate_hz)
        _receive(engines, min(_LOOK_S, max(0.0, due_s - time.monotonic())))
    _drain(engines)
    answers = sorted(answer for engine in engines for answer in engine.answers)
    return Phase(frames, unsent, answers, begun_s, sent_late_ms)


def _begin(engines: list[Engine], engine: Engine) -> None:
    engines.remove(engine)
    engines.append(engine)  # in turn
    engine.begin()


def _n_out(engines: list[Engine]) -> int:
    return sum(not engine.is_free for engine in engines)


def _drain(engines: list[Engine]) -> None:
    give_up_s = time.monotonic() + _TIMEOUT_S
    while _n_out(engines):
        if time.monotonic() > give_up_s:
            raise TimeoutError("answers are missing")
        _receive(engines, _LOOK_S)


def _receive(engines: list[Engine], wait_s: float) -> None:
    by_socket = {engine.socket: engine for engine in engines}
    for ready in select.select(by_socket, [], [], wait_s)[0]:  # by the microsecond, unlike epoll
        by_socket[ready].receive()


def _answered(reply: dict[str, Any], now_s: float, sent_s: float) -> Answered:
    reasons, cause = [reason for reason in reply.get("reasons") or () if reason], ""
    kind = "fallback" if reasons else "learned"
    if reasons:
        cause = Reason(Counter(reasons).most_common(1)[0][0]).name.lower()
    if reply["type"] == "error":
        if reply["code"] != "NOT_READY":
            raise ConnectionError(f"{reply['code']}: {reply['detail']}")
        kind = "refused"
    return Answered(now_s, 1e3 * (now_s - sent_s), kind, bool(reply.get("late")), reply["type"] == "actions", cause)


def _connect(url: str) -> socket.socket:
    connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connected.settimeout(_TIMEOUT_S)
    connected.connect(urlsplit(url).path)
    return connected
