"""Clients that are slow on purpose: silent after connecting, a byte a second, or never reading what they are sent.

This module knows nothing about the server but how its doors frame messages. It runs in a process of its own, so that
it slows nobody by sharing theirs.
"""

from __future__ import annotations

import selectors
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack

__all__ = ["BOTS", "KINDS", "Held", "hold"]

KINDS = ("silent", "header", "body", "reader")
_TICK_S = 0.02
_BYTE_EVERY_S = 1.0
_READERS = 4  # of each door: a server has to fill the buffers of each before it can notice
_RECEIVE_BYTES = 4096
_ASKED_A_TICK = 4
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
        self.kind, self.socket = kind, connected
        self.is_reader = bool(again)
        self._rest, self._again, self._unsent = rest, again, b""
        self._since_s = time.monotonic()
        self.open_s: float | None = None
        connected.setblocking(False)
        if first:
            connected.send(first)

    def send_byte(self) -> bool:
        """The next byte; whether there will be more."""
        if self.open_s is not None or not self._rest:
            return False
        with self._until_closed():
            self.socket.send(self._rest[:1])
            self._rest = self._rest[1:]
        return self.open_s is None and bool(self._rest)

    def receive(self) -> None:
        """Something has come: a last word, or the end."""
        with self._until_closed():
            while self.socket.recv(65536):
                pass
            raise ConnectionResetError

    def send_again(self) -> None:
        """Ask until nothing more is taken, without flooding; from then on it is the server that waits."""
        with self._until_closed():
            for _ in range(_ASKED_A_TICK):
                self._unsent = self._unsent or self._again
                self._unsent = self._unsent[self.socket.send(self._unsent) :]
                self._since_s = time.monotonic()

    @contextmanager
    def _until_closed(self) -> Iterator[None]:
        """Notices when the server has closed."""
        try:
            yield
        except BlockingIOError:
            return
        except OSError:
            self.open_s = self.open_s or time.monotonic() - self._since_s


def hold(address: str, count: int, wait_s: float) -> list[Held]:
    """Open `count` slow sockets to one door, of all kinds; wait until the server has closed them, at most so long."""
    kinds = [*("reader" for _ in range(min(_READERS, count // 4)))]
    kinds += [KINDS[index % 3] for index in range(count - len(kinds))]
    opened = _OPENED[urlsplit(address).scheme]
    slow = [opened[kind](address) for kind in kinds]
    _wait(slow, time.monotonic() + wait_s)
    for each in slow:
        each.socket.close()
    return [Held(each.kind, each.open_s) for each in slow]


def _wait(slow: list[_Slow], end_s: float) -> None:
    """Go on slowly, each at a moment of its own within the second. Asleep in between: the machine is shared."""
    begun_s, readers = time.monotonic(), [each for each in slow if each.is_reader]
    due = deque((begun_s + _BYTE_EVERY_S * (1 + row / len(slow)), each) for row, each in enumerate(slow))
    with selectors.DefaultSelector() as selector:
        for each in slow:
            if not each.is_reader:
                selector.register(each.socket, selectors.EVENT_READ, each)
        while (now_s := time.monotonic()) < end_s and any(each.open_s is None for each in slow):
            asking = [each for each in readers if each.open_s is None]
            next_s = min(end_s, due[0][0] if due else end_s, now_s + _TICK_S if asking else end_s)
            for key, _ in selector.select(max(0.0, next_s - now_s)):
                key.data.receive()
                if key.data.open_s is not None:
                    selector.unregister(key.fileobj)
                    key.data.socket.close()
            while due and due[0][0] <= time.monotonic():
                at_s, each = due.popleft()
                if each.send_byte():
                    due.append((at_s + _BYTE_EVERY_S, each))
            for each in asking:
                each.send_again()


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


class _Wire(NamedTuple):
    """How a door's sockets begin, and how a message is written and read there."""

    begin: Callable[[socket.socket, str], None]
    framed: Callable[[bytes], bytes]
    read: Callable[[bytes], bytes | None]  # the message's body, None as long as it is not whole


def _reader(address: str, wire: _Wire) -> _Slow:
    """Starts bots, asks for a frame, and then for the same again, without ever reading another answer."""
    connected = _connect(address)
    wire.begin(connected, address)

    def told(message: dict[str, Any]) -> dict[str, Any]:
        connected.sendall(wire.framed(msgpack.packb(message)))
        data = b""
        while (body := wire.read(data)) is None:
            data += _received(connected)
        return dict(msgpack.unpackb(body))

    welcome = told({"type": "hello"})
    bots = told({"type": "start_bots", "count": _READERS_BOTS})["bots"]
    free = [each for each in welcome["features"]["features"] if each["cost_us"] == 0.0]
    numbers = [each["low"] for each in free for _ in range(each["size"])] * _READERS_BOTS
    packed = struct.pack(f"<{len(numbers)}f", *numbers)
    query = {"type": "request_queries", "frame": 0, "bots": bots, "free": packed}
    told(query)
    return _Slow("reader", connected, b"", b"", wire.framed(msgpack.packb(query)))


def _slow_body(address: str, wire: _Wire) -> _Slow:
    """The beginning of a message of 1,000 bytes."""
    connected = _connect(address)
    wire.begin(connected, address)
    whole = wire.framed(b"\xc0" * 1000)
    return _Slow("body", connected, whole[:-1000], whole[-1000:], b"")


def _received(connected: socket.socket) -> bytes:
    part = connected.recv(65536)
    if not part:
        raise ConnectionResetError("the server closed the socket")
    return part


def _begin_nothing(connected: socket.socket, address: str) -> None:
    """A stream's first byte is its first message's."""


def _begin_websocket(connected: socket.socket, address: str) -> None:
    head = f"GET {urlsplit(address).path} HTTP/1.1\r\nHost: {urlsplit(address).netloc}\r\nUpgrade: websocket\r\n"
    head += "Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    connected.sendall(head.encode())
    answer = b""
    while not answer.endswith(b"\r\n\r\n"):
        answer += _received(connected)


def _stream_body(data: bytes) -> bytes | None:
    return data[4:] if len(data) >= 4 + int.from_bytes(data[:4], "big") > 4 else None


def _websocket_frame(body: bytes) -> bytes:
    """RFC 6455, 5.2: a whole binary message, with a mask of zeros."""
    if len(body) < 126:
        return bytes((0x82, 0x80 | len(body))) + bytes(4) + body
    return struct.pack(">BBH", 0x82, 0xFE, len(body)) + bytes(4) + body


def _websocket_body(data: bytes) -> bytes | None:
    if len(data) < 10:
        return None
    head, size = {126: (4, data[2:4]), 127: (10, data[2:10])}.get(data[1], (2, data[1:2]))
    return data[head:] if len(data) >= head + int.from_bytes(size, "big") else None


def _kind(kind: str, first: bytes = b"", rest: bytes = b"", again: bytes = b"") -> Callable[[str], _Slow]:
    return lambda address: _Slow(kind, _connect(address), first, rest, again)


_STREAM = _Wire(_begin_nothing, lambda body: struct.pack(">I", len(body)) + body, _stream_body)
_WEBSOCKET = _Wire(_begin_websocket, _websocket_frame, _websocket_body)
_HEADER = b"POST /v1/query HTTP/1.1\r\nHost: a\r\nContent-Type: application/msgpack\r\n"
_BY_HTTP = {"silent": _kind("silent"), "header": _kind("header", first=_HEADER[:1], rest=_HEADER[1:])}
_BY_STREAM = {
    "silent": _kind("silent"),
    "header": _kind("header", first=b"\0", rest=struct.pack(">I", 1000)[1:]),
    "body": partial(_slow_body, wire=_STREAM),
    "reader": partial(_reader, wire=_STREAM),
}
_OPENED: dict[str, dict[str, Callable[[str], _Slow]]] = {
    "http": _BY_HTTP
    | {
        "body": _kind("body", first=_HEADER + b"Content-Length: 1000\r\n\r\n", rest=b"\xc0" * 1000),
        "reader": _kind("reader", again=b"GET /v1/bundle HTTP/1.1\r\nHost: a\r\n\r\n"),
    },
    "ws": _BY_HTTP | {"body": partial(_slow_body, wire=_WEBSOCKET), "reader": partial(_reader, wire=_WEBSOCKET)},
    "tcp": _BY_STREAM,
    "unix": _BY_STREAM,
}
