"""Ways to carry one request's bytes to a server and one reply's bytes back, all blocking: HTTP, TCP, Unix sockets.

This module knows nothing about what the bytes say. A transport opens its socket when it is first needed, and closes it
after any failure: a late answer must never be read as the answer to the next request.
"""

from __future__ import annotations

import http.client
import socket
import struct
from typing import Protocol
from urllib.parse import urlsplit

__all__ = ["MAX_REPLY_BYTES", "ROUTES", "HttpTransport", "ReplyError", "StreamTransport", "Transport", "open_transport"]

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
_REPEATABLE = {
    "request_queries",
    "submit_features",
    "take_turn",
}  # a turn's retry gets the same answer and changes nothing
_CONTENT_TYPE = "application/msgpack"


class ReplyError(ConnectionError):
    """The server's answer is not one that the protocol allows here: not msgpack, not a known message, another frame."""


class Transport(Protocol):
    """One request's bytes out, one reply's bytes back. Raises OSError (TimeoutError, ConnectionError, ReplyError)."""

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """Send a message of type `kind` for this connection and wait for the bytes of its reply."""

    def close(self) -> None:
        """Close the socket, if one is open. A later exchange opens a new one."""


def open_transport(url: str, timeout_s: float) -> Transport:
    """The transport for `http://host:port`, `ws://host:port`, `tcp://host:port` or `unix:///path`.

    Raises ValueError for other URLs, ImportError where WebSockets need a package that is not installed.
    """
    parts = urlsplit(url)
    if parts.scheme == "unix" and parts.path and not parts.netloc:
        return StreamTransport(parts.path, timeout_s)
    if parts.scheme == "ws" and parts.hostname and parts.port and parts.path in ("", "/", SOCKET_PATH):
        return _web_socket(parts.hostname, parts.port, timeout_s)
    if parts.scheme in ("http", "tcp") and parts.hostname and parts.port and parts.path in ("", "/"):
        if parts.scheme == "http":
            return HttpTransport(parts.hostname, parts.port, timeout_s)
        return StreamTransport((parts.hostname, parts.port), timeout_s)
    raise ValueError(f"{url!r} is none of http://host:port, ws://host:port, tcp://host:port, unix:///path")


def _web_socket(host: str, port: int, timeout_s: float) -> Transport:
    try:
        from protocol.websocket import WebSocketTransport
    except ImportError as error:  # the only transport that needs a package
        raise ImportError("ws:// needs the package `websockets`: install the extra `server`, or it alone") from error
    return WebSocketTransport(host, port, SOCKET_PATH, timeout_s)


class HttpTransport:
    """One keep-alive HTTP/1.1 socket; a turn is sent once more if the server had closed it in the meantime."""

    def __init__(self, host: str, port: int, timeout_s: float) -> None:
        self._http = http.client.HTTPConnection(host, port, timeout=timeout_s)

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport. The status is not looked at: an Error message carries its own code."""
        reused = self._http.sock is not None
        try:
            return self._exchange(kind, body, connection)
        except ConnectionError:
            if not (reused and kind in _REPEATABLE):
                raise
        return self._exchange(kind, body, connection)

    def close(self) -> None:
        """See Transport."""
        self._http.close()

    def _exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        headers = {"Content-Type": _CONTENT_TYPE}
        if connection is not None:
            headers[CONNECTION_HEADER] = connection
        try:
            self._http.request("POST", ROUTES[kind], body, headers)
            with self._http.getresponse() as response:
                reply = response.read(MAX_REPLY_BYTES + 1)
                content_type = response.headers.get_content_type()
                if len(reply) > MAX_REPLY_BYTES or content_type != _CONTENT_TYPE:
                    raise ReplyError(f"HTTP {response.status} with {len(reply)} bytes of {content_type}")
                return reply
        except OSError:
            self.close()
            raise
        except http.client.HTTPException as error:
            self.close()
            raise ReplyError(f"not an HTTP answer: {error!r}") from error


class StreamTransport:
    """Frames of a 4-byte big-endian length and that many bytes, over TCP `(host, port)` or a Unix socket's path."""

    def __init__(self, address: tuple[str, int] | str, timeout_s: float) -> None:
        self._address = address
        self._timeout_s = timeout_s
        self._socket: socket.socket | None = None

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport. The socket is the connection, so neither `kind` nor `connection` travels beside the body."""
        try:
            if self._socket is None:
                self._socket = self._connect()
            self._socket.sendall(struct.pack(">I", len(body)) + body)
            (size,) = struct.unpack(">I", _read_exactly(self._socket, 4))
            if size > MAX_REPLY_BYTES:
                raise ReplyError(f"the server announces a reply of {size} bytes, more than {MAX_REPLY_BYTES}")
            return _read_exactly(self._socket, size)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """See Transport. Closing ends the connection and its bots."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> socket.socket:
        if isinstance(self._address, tuple):
            connected = socket.create_connection(self._address, timeout=self._timeout_s)
            connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return connected
        unconnected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            unconnected.settimeout(self._timeout_s)
            unconnected.connect(self._address)
        except OSError:
            unconnected.close()
            raise
        return unconnected


def _read_exactly(source: socket.socket, size: int) -> bytes:
    parts = bytearray()
    while len(parts) < size:
        part = source.recv(min(size - len(parts), 2**20))
        if not part:
            raise ConnectionResetError(f"the server closed the socket after {len(parts)} of {size} bytes")
        parts += part
    return bytes(parts)
