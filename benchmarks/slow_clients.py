"""Clients that are slow on purpose: silent after connecting, a byte a second, or never reading what they are sent.

This module knows nothing about the server but how its doors frame messages. It runs in a process of its own, so that
it slows nobody by sharing theirs.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack

__all__ = ["BOTS", "KINDS", "Held", "hold"]

KINDS = ("silent", "header", "body", "reader")
_TICK_S = 0.02
_BYTE_EVERY_S = 1.0
_READERS = 4  # of each door: a server has to fill the buffers of each before it can notice
_RECEIVE_BYTES = 4096
_ASKED_A_TICK = 16
_READERS_BOTS = 32  # of each such client: the more, the longer the answers

BOTS = _READERS * _READERS_BOTS
"""How many bots the slow clients of one door start."""


class Held(NamedTuple):
    """How long one slow socket was left open, in seconds since it last got on; None: longer than was waited."""

    kind: str
    open_s: float | None


class _Slow:
    """One socket and what it sends: `first` at once, then a byte a second, or `again` as often as it is taken."""

    def __init__(self, kind: str, connected: socket.socket, first: bytes, rest: bytes, again: bytes) -> None:
        self.kind, self._socket = kind, connected
        self._rest, self._again, self._unsent = rest, again, b""
        self._since_s = self._byte_at_s = time.monotonic()
        self.open_s: float | None = None
        connected.setblocking(False)
        if first:
            connected.send(first)

    def tick(self) -> None:
        """Go on, slowly; notices when the server has closed."""
        now_s = time.monotonic()
        try:
            if self._again:
                self._send_again(now_s)
            else:
                if self._rest and now_s >= self._byte_at_s + _BYTE_EVERY_S:
                    self._socket.send(self._rest[:1])
                    self._rest, self._byte_at_s = self._rest[1:], now_s
                while self._socket.recv(65536):
                    pass  # a last word before it closes
                raise ConnectionResetError
        except BlockingIOError:
            return
        except OSError:
            self.open_s = now_s - self._since_s
            self._socket.close()

    def _send_again(self, now_s: float) -> None:
        """Ask until nothing more is taken, without flooding; from then on it is the server that waits."""
        for _ in range(_ASKED_A_TICK):
            self._unsent = self._unsent or self._again
            self._unsent = self._unsent[self._socket.send(self._unsent) :]
            self._since_s = now_s

    def close(self) -> None:
        """Give up waiting."""
        self._socket.close()


def hold(address: str, count: int, wait_s: float) -> list[Held]:
    """Open `count` slow sockets to one door, of all kinds; wait until the server has closed them, at most so long."""
    kinds = [*("reader" for _ in range(min(_READERS, count // 4)))]
    kinds += [KINDS[index % 3] for index in range(count - len(kinds))]
    opened = _HTTP if address.startswith("http") else _STREAM
    slow = [opened[kind](address) for kind in kinds]
    end_s = time.monotonic() + wait_s
    while time.monotonic() < end_s and any(each.open_s is None for each in slow):
        for each in slow:
            if each.open_s is None:
                each.tick()
        time.sleep(_TICK_S)
    for each in slow:
        each.close()
    return [Held(each.kind, each.open_s) for each in slow]


def _connect(address: str) -> socket.socket:
    parts = urlsplit(address)
    family, where = (
        (socket.AF_UNIX, parts.path)
        if parts.scheme == "unix"
        else (socket.AF_INET, (str(parts.hostname), int(str(parts.port))))
    )
    connected = socket.socket(family, socket.SOCK_STREAM)
    connected.settimeout(10.0)
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
    connected.connect(where)
    return connected


def _kind(kind: str, first: bytes = b"", rest: bytes = b"", again: bytes = b"") -> Callable[[str], _Slow]:
    return lambda address: _Slow(kind, _connect(address), first, rest, again)


def _stream_reader(address: str) -> _Slow:
    """Starts bots, asks for a frame, and then for the same again, without ever reading another answer."""
    connected = _connect(address)
    welcome = _told(connected, {"type": "hello"})
    bots = _told(connected, {"type": "start_bots", "count": _READERS_BOTS})["bots"]
    free = [each for each in welcome["features"]["features"] if each["cost_us"] == 0.0]
    numbers = [each["low"] for each in free for _ in range(each["size"])] * _READERS_BOTS
    packed = struct.pack(f"<{len(numbers)}f", *numbers)
    query = {"type": "request_queries", "frame": 0, "bots": bots, "free": packed}
    _told(connected, query)
    return _Slow("reader", connected, b"", b"", _framed(query))


def _told(connected: socket.socket, message: dict[str, Any]) -> dict[str, Any]:
    """The reply to a message, read as anybody would."""
    connected.sendall(_framed(message))
    data = b""
    while len(data) < 4 or len(data) < 4 + int.from_bytes(data[:4], "big"):
        part = connected.recv(65536)
        if not part:
            raise ConnectionResetError("the server closed the socket")
        data += part
    return dict(msgpack.unpackb(data[4:]))


def _framed(message: dict[str, Any]) -> bytes:
    body = msgpack.packb(message)
    return struct.pack(">I", len(body)) + body


_HEADER = b"POST /v1/query HTTP/1.1\r\nHost: a\r\nContent-Type: application/msgpack\r\n"
_HTTP = {
    "silent": _kind("silent"),
    "header": _kind("header", first=_HEADER[:1], rest=_HEADER[1:]),
    "body": _kind("body", first=_HEADER + b"Content-Length: 1000\r\n\r\n", rest=b"\xc0" * 1000),
    "reader": _kind("reader", again=b"GET /v1/bundle HTTP/1.1\r\nHost: a\r\n\r\n"),
}
_STREAM = {
    "silent": _kind("silent"),
    "header": _kind("header", first=b"\0", rest=struct.pack(">I", 1000)[1:]),
    "body": _kind("body", first=struct.pack(">I", 1000), rest=b"\xc0" * 1000),
    "reader": _stream_reader,
}
