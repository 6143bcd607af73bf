"""The stream door: length-prefixed msgpack frames over TCP or a Unix socket, one connection a socket.

This module knows nothing about what a message does. Frames are 4 bytes of big-endian length and that many bytes, both
ways, one reply a request.
"""

from __future__ import annotations

import struct

from protocol.codec import LEAST_LIMIT_BYTES, Format
from protocol.errors import ProtocolError, TooLarge
from server.answer import refusal
from server.conversation import Conversation
from server.sockets import Sockets

__all__ = ["StreamSocket"]

_PREFIX = struct.Struct(">I")


class StreamSocket(Conversation):
    """One client's socket; `name` is `tcp` or `unix`."""

    def __init__(self, sockets: Sockets, name: str) -> None:
        super().__init__(sockets, name)
        self._buffer: bytes | bytearray = b""

    def _feed(self, data: bytes) -> None:
        if not self._buffer:
            self._buffer = data
        else:  # in a bytearray, as a frame that comes byte by byte must not be copied for each
            self._buffer = bytearray(self._buffer) if isinstance(self._buffer, bytes) else self._buffer
            self._buffer += data

    def _next(self) -> bytes | None:
        buffer = self._buffer
        if len(buffer) < _PREFIX.size:
            return None
        (size,) = _PREFIX.unpack_from(buffer)
        if size > LEAST_LIMIT_BYTES:
            limit = self._sockets.desk.handlers.max_bytes(self._connection, Format.MSGPACK)
            if size > limit:
                self._refuse(TooLarge(f"the frame has {size} bytes, the limit is {limit}"))
                return None
        end = _PREFIX.size + size
        if len(buffer) < end:
            return None
        self._buffer = buffer[end:]
        return bytes(buffer[_PREFIX.size : end])

    @property
    def _has_part(self) -> bool:
        return bool(self._buffer)

    def _framed(self, body: bytes) -> bytes:
        return _PREFIX.pack(len(body)) + body

    def _refuse(self, error: ProtocolError) -> None:
        self._sockets.desk.handlers.recorder.refused(self.name, error.code)
        self._transport.write(self._framed(refusal(error, Format.MSGPACK).body))
        self._end()
