"""The stream door: length-prefixed msgpack frames over TCP or a Unix socket, one connection a socket.

This module knows nothing about what a message does. Frames are 4 bytes of big-endian length and that many bytes, both
ways, one reply a request. The next request is read only after the reply went out, so neither side can pile up.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from socket import AF_UNIX

from protocol.codec import Format
from protocol.errors import NotReady, TooLarge, TooManyConnections
from protocol.messages import Farewell, Welcome
from server.answer import Answer, Arrival, answer, refusal
from server.handlers import Handlers
from server.worker import Worker

__all__ = ["StreamDoor"]

_PREFIX = struct.Struct(">I")
_DISCARD_BYTES = 65536


class StreamDoor:
    """Accepts sockets (`serve` is the callback of `asyncio.start_server` and `start_unix_server`) and drains them.

    A socket closes when its client does, after `idle_ttl_s` of silence between frames, and after `frame_deadline_s` of
    a request that does not end, a reply that is not taken, or a hello that does not come.
    """

    def __init__(
        self, handlers: Handlers, worker: Worker, *, max_sockets: int, frame_deadline_s: float, idle_ttl_s: float
    ) -> None:
        self._handlers = handlers
        self._worker = worker
        self._max_sockets = max_sockets
        self._frame_deadline_s = frame_deadline_s
        self._idle_ttl_s = idle_ttl_s
        self._open: dict[_Socket, asyncio.Task[None]] = {}
        self._draining = False

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one socket's requests, one after the other, until it closes."""
        socket = _Socket(reader, writer, self._frame_deadline_s)
        task = asyncio.current_task()
        try:
            if len(self._open) >= self._max_sockets:
                full = TooManyConnections(f"all {self._max_sockets} sockets are taken", retry_after_s=1.0)
                await socket.send(refusal(full, Format.MSGPACK).body)
            elif task is not None:
                self._open[socket] = task
                await self._converse(socket)
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client went away or was too slow: there is nobody to tell
        finally:
            self._open.pop(socket, None)
            if socket.connection is not None:
                self._worker.post(partial(self._handlers.end, socket.connection))
            await socket.close()

    async def drain(self, timeout_s: float) -> None:
        """Close the sockets that no whole request came from, let requests in progress be answered, close the rest.

        Waits for at most `timeout_s`.
        """
        self._draining = True
        for socket in self._open:
            if socket.receiving:
                socket.abort()
        if self._open:
            _, late = await asyncio.wait(self._open.values(), timeout=timeout_s)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)

    async def _converse(self, socket: _Socket) -> None:
        while not self._draining:
            silence_s = self._frame_deadline_s if socket.connection is None else self._idle_ttl_s
            try:
                body = await socket.receive(silence_s, self._handlers.max_body_bytes[Format.MSGPACK])
            except TooLarge as error:
                await socket.send(refusal(error, Format.MSGPACK).body)
                await socket.discard()
                return
            arrival = Arrival.now(socket.transport)
            reply = await self._answer(
                partial(answer, self._handlers, body, Format.MSGPACK, socket.connection, arrival)
            )
            if isinstance(reply.reply, Welcome):
                socket.connection = reply.reply.connection
            await socket.send(reply.body)
            if isinstance(reply.reply, Farewell):
                return

    async def _answer(self, job: Callable[[], Answer]) -> Answer:
        try:
            return await self._worker.run(job)
        except NotReady as error:
            return refusal(error, Format.MSGPACK)


class _Socket:
    """One client's socket: frames in, frames out, each against a deadline."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, deadline_s: float) -> None:
        self._reader = reader
        self._writer = writer
        self._deadline_s = deadline_s
        self.transport = "unix" if writer.get_extra_info("socket").family is AF_UNIX else "tcp"
        self.connection: str | None = None
        self.receiving = False

    async def receive(self, silence_s: float, limit: int) -> bytes:
        """The next frame's body. Raises TooLarge, TimeoutError, IncompleteReadError where the client closed."""
        self.receiving = True
        async with asyncio.timeout(silence_s):
            first = await self._reader.readexactly(1)
        async with asyncio.timeout(self._deadline_s):
            (size,) = _PREFIX.unpack(first + await self._reader.readexactly(_PREFIX.size - 1))
            if size > limit:
                raise TooLarge(f"the frame has {size} bytes, the limit is {limit}")
            body = await self._reader.readexactly(size)
        self.receiving = False
        return body

    async def send(self, body: bytes) -> None:
        """Send one frame; raises TimeoutError when the client does not read its replies."""
        self._writer.write(_PREFIX.pack(len(body)) + body)
        async with asyncio.timeout(self._deadline_s):
            await self._writer.drain()

    async def discard(self) -> None:
        """Read on without looking, so that the last reply is not lost to a reset while the client is still sending."""
        with suppress(OSError):
            self._writer.write_eof()
            async with asyncio.timeout(self._deadline_s):
                while await self._reader.read(_DISCARD_BYTES):
                    pass

    def abort(self) -> None:
        """Close without waiting; whoever waits for the next frame sees the end of the stream."""
        self._writer.transport.abort()

    async def close(self) -> None:
        """Close, giving what was written a last chance to leave."""
        self._writer.close()
        try:
            async with asyncio.timeout(self._deadline_s):
                await self._writer.wait_closed()
        except OSError:
            self.abort()
