"""Messages as binary frames of a WebSocket, blocking: the transport where an engine has no sockets but these.

This module knows nothing about what the bytes say. It needs the package `websockets`, which other transports do not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidHandshake
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import WebSocketURI

from protocol.dial import Socket
from protocol.transport import MAX_REPLY_BYTES, ReplyError

__all__ = ["WebSocketTransport"]

_READ_BYTES = 65536


class WebSocketTransport:
    """One WebSocket at `ws://host:port/path`, or `wss`, which is the connection; no compression, no subprotocol."""

    def __init__(self, host: str, port: int, path: str, dialled: Callable[[], Socket], *, is_secure: bool) -> None:
        self._uri = WebSocketURI(is_secure, host, port, path, "")
        self._dial = dialled
        self._socket: Socket | None = None

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport. The socket is the connection, so neither `kind` nor `connection` travels beside the body."""
        try:
            opened = self._socket or self._connect()
            if self._protocol.state is not State.OPEN:
                raise self._closed()
            self._protocol.send_binary(body)
            self._flush(opened)
            while not self._messages:
                self._receive(opened)
            return self._messages.popleft()
        except BaseException:  # an interrupt too: its answer would be read as that to the next request
            self.close()
            raise

    def close(self) -> None:
        """See Transport. Closing ends the connection and its bots."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _connect(self) -> Socket:
        self._protocol = ClientProtocol(self._uri, max_size=MAX_REPLY_BYTES)
        self._messages: deque[bytes] = deque()
        self._fragments: list[bytes] = []
        self._socket = opened = self._dial()
        self._protocol.send_request(self._protocol.connect())
        self._flush(opened)
        while self._protocol.state is State.CONNECTING:
            self._receive(opened)
        return opened

    def _receive(self, opened: Socket) -> None:
        data = opened.recv(_READ_BYTES)
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        for event in self._protocol.events_received():
            if isinstance(event, Frame):
                self._take(event)
        if isinstance(self._protocol.handshake_exc, InvalidHandshake):
            raise ReplyError(f"the server opened no WebSocket: {self._protocol.handshake_exc}")
        self._flush(opened)
        if not data or (self._protocol.state is not State.OPEN and not self._messages):
            raise self._closed()

    def _closed(self) -> ConnectionResetError:
        said = self._protocol.close_rcvd
        return ConnectionResetError(f"the server closed the socket: {said or 'without a word'}")

    def _take(self, frame: Frame) -> None:
        if frame.opcode is Opcode.BINARY or frame.opcode is Opcode.CONT:
            self._fragments.append(bytes(frame.data))
            if frame.fin:
                self._messages.append(b"".join(self._fragments))
                self._fragments.clear()
        elif frame.opcode is Opcode.TEXT:
            raise ReplyError("the server answered with text, expected a binary frame")

    def _flush(self, opened: Socket) -> None:
        pending = b"".join(self._protocol.data_to_send())
        if pending:
            opened.sendall(pending)
