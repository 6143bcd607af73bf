"""Ways to carry one request's bytes to a server and one reply's bytes back, all blocking: HTTP, TCP, Unix sockets, TLS.

This module knows nothing about what the bytes say. A transport opens its socket when it is first needed, and closes it
after any failure: a late answer must never be read as the answer to the next request.
"""

from __future__ import annotations

import select
import ssl
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from protocol.dial import MAX_SPIN_US, Socket, dial

__all__ = [
    "MAX_REPLY_BYTES",
    "ROUTES",
    "HttpTransport",
    "ReplyError",
    "StreamTransport",
    "Transport",
    "open_transport",
]

MAX_REPLY_BYTES = 64 * 2**20
CONNECTION_HEADER = "X-Bot-Connection"
ROUTES = {
    "hello": "/v1/connections",
    "start_bots": "/v1/bots/start",
    "request_queries": "/v1/query",
    "submit_features": "/v1/act",
    "take_turn": "/v1/turn",
    "stop_bots": "/v1/bots/stop",
    "goodbye": "/v1/connections/close",
}
SOCKET_PATH = "/v1/socket"
_DOORS = {"http": "http", "https": "http", "ws": "ws", "wss": "ws", "tcp": "tcp", "tcps": "tcp"}
_REPEATABLE = {
    "request_queries",
    "submit_features",
    "take_turn",
}  # a turn's retry gets the same answer and changes nothing
_CONTENT_TYPE = "application/msgpack"
_PREFIX = struct.Struct(">I")
_READ_BYTES = 65536
_MAX_HEAD_BYTES = 65536


class ReplyError(ConnectionError):
    """The server's answer is not one that the protocol allows here: not msgpack, not a known message, another frame."""


class Transport(Protocol):
    """One request's bytes out, one reply's bytes back. Raises OSError (TimeoutError, ConnectionError, ReplyError)."""

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """Send a message of type `kind` for this connection and wait for the bytes of its reply."""

    def close(self) -> None:
        """Close the socket, if one is open. A later exchange opens a new one."""


def open_transport(url: str, timeout_s: float, *, cafile: Path | None = None, spin_us: float = 0.0) -> Transport:
    """The transport for `http://host:port`, `ws://host:port`, `tcp://host:port` or `unix:///path`.

    `https`, `wss` and `tcps` are the same over TLS, to a server whose certificate is for `host` and signed by one of
    the system's authorities, or by one in `cafile` (PEM) instead. An answer is polled for during `spin_us` before the
    thread sleeps until it comes. Raises ValueError for other URLs, for more than `MAX_SPIN_US` and where nothing can be
    polled, OSError for a `cafile` that holds none, ImportError where WebSockets need a package that is not installed.
    """
    if not 0.0 <= spin_us <= MAX_SPIN_US or (spin_us and not hasattr(select, "poll")):
        raise ValueError(f"spin_us is {spin_us}, expected 0 to {MAX_SPIN_US:g}, and 0 on systems without poll")
    parts = urlsplit(url)
    if parts.scheme == "unix" and parts.path and not parts.netloc:
        return StreamTransport(partial(dial, parts.path, timeout_s, None, spin_us))
    door = _DOORS.get(parts.scheme)
    if door is not None and parts.hostname and parts.port:
        host, port = parts.hostname, parts.port
        tls = None if parts.scheme == door else ssl.create_default_context(cafile=cafile)
        dialled = partial(dial, (host, port), timeout_s, tls, spin_us)
        if door == "ws" and parts.path in ("", "/", SOCKET_PATH):
            return _web_socket(host, port, dialled, is_secure=tls is not None)
        if door == "http" and parts.path in ("", "/"):
            return HttpTransport(host, port, dialled)
        if door == "tcp" and parts.path in ("", "/"):
            return StreamTransport(dialled)
    raise ValueError(
        f"{url!r} is none of http://host:port, ws://host:port, tcp://host:port, unix:///path, or https, wss, tcps"
    )


def _web_socket(host: str, port: int, dialled: Callable[[], Socket], *, is_secure: bool) -> Transport:
    try:
        from protocol.websocket import WebSocketTransport
    except ImportError as error:  # the only transport that needs a package
        raise ImportError("ws:// needs the package `websockets`: install the extra `server`, or it alone") from error
    return WebSocketTransport(host, port, SOCKET_PATH, dialled, is_secure=is_secure)


class HttpTransport:
    """One keep-alive HTTP/1.1 socket; a turn is sent once more if the server had closed it in the meantime.

    It speaks as much HTTP as the server does: replies with a `Content-Length`. `http.client` takes twice as long.
    """

    def __init__(self, host: str, port: int, dialled: Callable[[], Socket]) -> None:
        self._dial = dialled
        name = f"[{host}]" if ":" in host else host
        rest = f" HTTP/1.1\r\nHost: {name}:{port}\r\nContent-Type: {_CONTENT_TYPE}\r\nContent-Length: "
        self._heads = {kind: f"POST {path}{rest}".encode("ascii") for kind, path in ROUTES.items()}
        self._socket: Socket | None = None

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport. The status is not looked at: an Error message carries its own code."""
        reused = self._socket is not None
        try:
            return self._exchange(kind, body, connection)
        except (ConnectionError, ssl.SSLEOFError, ssl.SSLZeroReturnError):  # what a closed socket says under TLS
            if not (reused and kind in _REPEATABLE):
                raise
        return self._exchange(kind, body, connection)

    def close(self) -> None:
        """See Transport."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        named = b"" if connection is None else f"\r\n{CONNECTION_HEADER}: {connection}".encode("ascii")
        try:
            if self._socket is None:
                self._socket = self._dial()
            self._socket.sendall(b"%b%d%b\r\n\r\n%b" % (self._heads[kind], len(body), named, body))
            reply, is_kept = _read_http(self._socket)
        except BaseException:  # an interrupt too: its answer would be read as that to the next request
            self.close()
            raise
        if not is_kept:
            self.close()
        return reply


class StreamTransport:
    """Frames of a 4-byte big-endian length and that many bytes, over TCP or a Unix socket."""

    def __init__(self, dialled: Callable[[], Socket]) -> None:
        self._dial = dialled
        self._socket: Socket | None = None

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport. The socket is the connection, so neither `kind` nor `connection` travels beside the body."""
        try:
            if self._socket is None:
                self._socket = self._dial()
            self._socket.sendall(_PREFIX.pack(len(body)) + body)
            return _read_frame(self._socket)
        except BaseException:  # an interrupt too: its answer would be read as that to the next request
            self.close()
            raise

    def close(self) -> None:
        """See Transport. Closing ends the connection and its bots."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _read_http(source: Socket) -> tuple[bytes, bool]:
    """One reply's body, and whether the server keeps the socket open. Raises ReplyError for what is no such reply."""
    data = source.recv(_READ_BYTES)
    while (end := data.find(b"\r\n\r\n")) < 0:
        if len(data) > _MAX_HEAD_BYTES:
            raise ReplyError(f"the head of an HTTP answer does not end within {_MAX_HEAD_BYTES} bytes")
        part = source.recv(_READ_BYTES)
        if not part:
            raise ConnectionResetError(f"the server closed the socket after {len(data)} bytes of a head")
        data += part
    status, *lines = data[:end].decode("latin-1").split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    size, kind = headers.get("content-length", ""), headers.get("content-type", "").partition(";")[0]
    if not status.startswith("HTTP/1.") or not (size.isascii() and size.isdigit() and len(size) < 10):
        raise ReplyError(f"not an HTTP answer with a Content-Length: {status[:80]!r}")
    if int(size) > MAX_REPLY_BYTES or kind.lower() != _CONTENT_TYPE:
        raise ReplyError(f"{status[:80]!r} with {size} bytes of {kind[:80]!r}")
    body, missing = data[end + 4 :], int(size) - (len(data) - end - 4)
    if missing < 0:
        raise ReplyError(f"{-missing} bytes follow the answer")
    if missing:
        body += _read_exactly(source, missing)
    is_kept = status.startswith("HTTP/1.1") and "close" not in headers.get("connection", "").lower()
    return body, is_kept


def _read_frame(source: Socket) -> bytes:
    """One frame's body, nearly always read in one go. Raises ReplyError for one that is too large, or not alone."""
    data = source.recv(_READ_BYTES)
    if len(data) < 4:
        data += _read_exactly(source, 4 - len(data))
    (size,) = _PREFIX.unpack_from(data)
    if size > MAX_REPLY_BYTES:
        raise ReplyError(f"the server announces a reply of {size} bytes, more than {MAX_REPLY_BYTES}")
    missing = size - (len(data) - 4)
    if missing < 0:
        raise ReplyError(f"{-missing} bytes follow the reply")
    return data[4:] + _read_exactly(source, missing) if missing else data[4:]


def _read_exactly(source: Socket, size: int) -> bytes:
    parts = bytearray()
    while len(parts) < size:
        part = source.recv(min(size - len(parts), 2**20))
        if not part:
            raise ConnectionResetError(f"the server closed the socket after {len(parts)} of {size} bytes")
        parts += part
    return bytes(parts)
