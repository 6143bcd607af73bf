"""The WebSocket door: messages as binary frames of msgpack at `/v1/socket` of the HTTP port, one connection a socket.

This module knows nothing about what a message does. The library speaks the WebSocket protocol (RFC 6455) and does no
I/O of its own; nothing is compressed, and text frames are refused.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from http import HTTPStatus
from typing import cast

from websockets.exceptions import PayloadTooBig
from websockets.frames import CloseCode, Frame, Opcode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.server import ServerProtocol
from websockets.typing import Origin

from protocol.codec import Format
from protocol.errors import ProtocolError, TooLarge, TooManyConnections
from protocol.messages import Welcome
from protocol.transport import SOCKET_PATH
from server.conversation import Conversation
from server.crowd import Crowd
from server.sockets import Sockets

__all__ = ["WebSocket", "web_socket"]

_library_log = logging.getLogger("websockets.server")
_library_log.setLevel(logging.WARNING)  # it has a line for every socket


class WebSocket(Conversation):
    """One client's socket, given by the HTTP door with the bytes of its upgrade request.

    A browser says which page asks (Origin), so a page that is not one of `origins` takes no bots; other clients say
    nothing. Pings are answered and put off no deadline. It keeps the place in the `crowd` that it got from there.
    """

    def __init__(self, sockets: Sockets, origins: Sequence[str], crowd: Crowd) -> None:
        super().__init__(sockets, "ws")
        self._crowd = crowd
        self._protocol = ServerProtocol(
            origins=[None, *(cast("Origin", origin) for origin in origins)],
            max_size=sockets.desk.handlers.max_bytes(None, Format.MSGPACK),
            logger=_library_log,
        )
        self._bodies: deque[bytes] = deque()
        self._fragments: bytearray | None = None
        self._is_within_frame = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See asyncio.Protocol. The socket counts once its handshake has been accepted."""
        self._open(transport)

    def connection_lost(self, error: Exception | None) -> None:
        """See Conversation."""
        super().connection_lost(error)
        self._crowd.leave()

    def finish(self) -> None:
        """See Sockets."""
        self._say_goodbye(CloseCode.GOING_AWAY)
        super()._close()

    def _feed(self, data: bytes) -> None:
        self._protocol.receive_data(data)
        events = self._protocol.events_received()
        for event in events:
            if isinstance(event, Request):
                self._accept(event)
            elif isinstance(event, Frame):
                self._take(event)
        if isinstance(self._protocol.parser_exc, PayloadTooBig):
            self._count_refused(TooLarge)
        self._is_within_frame = not events or bool(self._protocol.reader.buffer)
        self._flush()

    def _next(self) -> bytes | None:
        return self._bodies.popleft() if self._bodies else None

    @property
    def _has_part(self) -> bool:
        return bool(self._bodies) or self._fragments is not None or self._is_within_frame

    def _welcomed(self, welcome: Welcome) -> None:
        self._protocol.max_message_size = welcome.max_body_bytes

    def _framed(self, body: bytes) -> bytes:
        self._protocol.send_binary(body)
        return b"".join(self._protocol.data_to_send())

    def _close(self) -> None:
        self._say_goodbye(CloseCode.NORMAL_CLOSURE)
        super()._close()

    def _accept(self, request: Request) -> None:
        self._protocol.send_response(self._response(request))

    def _response(self, request: Request) -> Response:
        if request.path.partition("?")[0] != SOCKET_PATH:
            return self._protocol.reject(HTTPStatus.NOT_FOUND, f"sockets are served at {SOCKET_PATH}\n")
        try:
            self._sockets.add(self)
        except TooManyConnections as error:
            self._count_refused(TooManyConnections)
            return self._protocol.reject(HTTPStatus.SERVICE_UNAVAILABLE, f"{error.detail}\n")
        return self._protocol.accept(request)

    def _take(self, frame: Frame) -> None:
        if frame.opcode is Opcode.TEXT:
            self._protocol.fail(CloseCode.UNSUPPORTED_DATA, "messages are binary frames of msgpack")
        elif frame.opcode is Opcode.BINARY and frame.fin:
            self._bodies.append(bytes(frame.data))
        elif frame.opcode is Opcode.BINARY:
            self._fragments = bytearray(frame.data)
        elif frame.opcode is Opcode.CONT and self._fragments is not None:
            self._fragments += frame.data
            if frame.fin:
                self._bodies.append(bytes(self._fragments))
                self._fragments = None

    def _count_refused(self, error: type[ProtocolError]) -> None:
        self._sockets.desk.handlers.recorder.refused(self.name, error.code)

    def _say_goodbye(self, code: CloseCode) -> None:
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code)
            self._flush()

    def _flush(self) -> None:
        """Send what the library has to say; where it has said its last word, wait for the client to close."""
        for data in self._protocol.data_to_send():
            if data:
                self._transport.write(data)
            else:
                self._end()


def web_socket(sockets: Sockets, origins: Sequence[str], crowd: Crowd) -> Callable[..., WebSocket]:
    """The protocol as uvicorn's Config takes it: what uvicorn says about itself is not needed."""

    def make(**_: object) -> WebSocket:
        return WebSocket(sockets, origins, crowd)

    return make
