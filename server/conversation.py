"""One socket's requests and replies, one after the other, each against a deadline. How they are framed, subclasses say.

This module knows nothing about what a message does. The next request is looked at only after the reply to the last
went out, and reading stops until then, so neither side can pile up.
"""

from __future__ import annotations

import asyncio
from abc import abstractmethod
from typing import cast

from protocol.codec import Format
from protocol.errors import TooManyConnections, Unauthorized
from protocol.messages import Farewell, Welcome
from server.answer import Answer, Arrival, refusal
from server.logs import logger
from server.sockets import Sockets

__all__ = ["Conversation"]

_LEAVE_S = 1.0  # how long a client that finds no room may take to say hello, and hear of it
_log = logger(__name__)


class Conversation(asyncio.Protocol):
    """A socket, which is a connection. `name` is the transport's, as in Arrival."""

    def __init__(self, sockets: Sockets, name: str) -> None:
        self._sockets = sockets
        self.name = name
        self._connection: str | None = None
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._due_s = 0.0  # when it is too late, on the event loop's clock
        self._silence_s = sockets.frame_deadline_s  # how long may pass between requests
        self.is_busy = False
        self._is_begun = False  # part of a request has come
        self._is_stuck = False  # the client does not take what it was sent
        self._is_paused = False
        self._is_over = False  # whatever else comes is not looked at
        self._refused: Answer | None = None  # to whatever comes first
        self._is_eof = False

    @abstractmethod
    def _feed(self, data: bytes) -> None:
        """Keep what has come."""

    @abstractmethod
    def _next(self) -> bytes | None:
        """The next whole request's body, if it is all there; one that is too large is refused here."""

    @property
    @abstractmethod
    def _has_part(self) -> bool:
        """Whether something has come that `_next` did not give yet."""

    @abstractmethod
    def _framed(self, body: bytes) -> bytes:
        """A reply as it travels."""

    def _welcomed(self, welcome: Welcome) -> None:  # most need do nothing about it
        """Hello was answered: longer messages may come from now on."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """See asyncio.Protocol."""
        self._open(transport)
        try:
            self._sockets.add(self)
        except TooManyConnections as error:
            self._sockets.desk.handlers.recorder.refused(self.name, error.code)
            _log.warning("hello refused", transport=self.name, code=error.code)
            self._refused = refusal(error, Format.MSGPACK)
            self._expect(min(_LEAVE_S, self._sockets.frame_deadline_s))

    def _open(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)
        # Else uvloop sends what is written in one look at the sockets only after it, when others were answered too.
        self._transport.set_write_buffer_limits(high=0)
        self._expect(self._sockets.frame_deadline_s)

    def connection_lost(self, error: Exception | None) -> None:
        """See asyncio.Protocol. The connection ends, its bots with it."""
        self._is_over = True
        self._sockets.remove(self)
        if self._timer is not None:
            self._timer.cancel()
        if self._connection is not None:
            self._sockets.desk.end(self._connection)

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol."""
        if self._is_over:
            return
        self._feed(data)
        if self.is_busy or self._is_stuck:
            self._transport.pause_reading()
            self._is_paused = True
        else:
            self._proceed()

    def eof_received(self) -> bool:
        """See asyncio.Protocol. What was asked for before is still answered."""
        self._is_eof = True
        return self.is_busy

    def pause_writing(self) -> None:
        """See asyncio.Protocol."""
        self._is_stuck = True
        self._expect(self._sockets.frame_deadline_s)

    def resume_writing(self) -> None:
        """See asyncio.Protocol."""
        self._is_stuck = False
        if not (self.is_busy or self._is_over):
            self._expect(self._silence_s)
            self._proceed()

    def finish(self) -> None:
        """See Sockets: nothing more is answered here."""
        self._close()

    def abort(self) -> None:
        """See Sockets."""
        self._transport.abort()

    def _proceed(self) -> None:
        """Answer the next request, if it is all there."""
        body = None if self._is_over else self._next()
        if self._is_over:
            return
        if body is None:
            self._wait()
            return
        if self._refused is not None:
            self._transport.write(self._framed(self._refused.body))
            self._end()
            return
        self.is_busy, self._is_begun = True, False
        arrival = Arrival.now(self.name)
        answered = self._sockets.desk.ask(body, Format.MSGPACK, self._connection, arrival)
        if isinstance(answered, Answer):
            self._reply(answered)
        else:
            self._due_s = float("inf")
            answered.add_done_callback(lambda future: self._reply(future.result()))

    def _reply(self, answered: Answer) -> None:
        if answered.status == Unauthorized.status:
            self._loop.call_later(self._sockets.brake.wait_s(), self._send, answered)
        else:
            self._send(answered)

    def _send(self, answered: Answer) -> None:
        self.is_busy = False
        if isinstance(answered.reply, Welcome):
            self._connection, self._silence_s = answered.reply.connection, self._sockets.idle_ttl_s
            self._welcomed(answered.reply)
        if self._is_over:  # the client has left in the meantime
            if isinstance(answered.reply, Welcome):
                self._sockets.desk.end(answered.reply.connection)
            return
        self._transport.write(self._framed(answered.body))
        self._sockets.vigil.begin()
        if isinstance(answered.reply, Farewell) or self._sockets.draining:
            self._close()
        elif not self._is_stuck:
            self._expect(self._silence_s)  # from now on, whatever comes that is no request
            if self._has_part:
                self.is_busy = True  # it is, in the next round of the event loop: other sockets have their turn first
                self._loop.call_soon(self._go_on)
            else:
                self._listen()

    def _go_on(self) -> None:
        self.is_busy = False
        if not (self._is_over or self._is_stuck):
            self._proceed()

    def _wait(self) -> None:
        """For the rest of a request, or for the next one."""
        self._listen()
        if self._has_part and not self._is_begun and not self._is_over:
            self._is_begun = True
            self._expect(self._sockets.frame_deadline_s)

    def _listen(self) -> None:
        """There is no whole request: wait for more, unless nothing more will come."""
        if self._is_eof:
            self._close()
        elif self._is_paused:
            self._read_on()

    def _read_on(self) -> None:
        if self._is_paused:
            self._is_paused = False
            self._transport.resume_reading()

    def _close(self) -> None:
        """Close, giving what was written a last chance to leave."""
        self._is_over = True
        self._transport.close()
        self._expect(self._sockets.frame_deadline_s)

    def _end(self) -> None:
        """The last word has been written. Read on without looking until the client closes, within the deadline.

        Closing while the client is still sending would reset the socket, and what was written would be lost.
        """
        self._is_over = True
        self._read_on()
        self._transport.write_eof()
        self._expect(self._sockets.frame_deadline_s)

    def _expect(self, within_s: float) -> None:
        """Close the socket unless something else is expected before so many seconds have passed.

        One timer a socket, which looks again when it is due: a request sets a number and no timer.
        """
        self._due_s = self._loop.time() + within_s
        if self._timer is None or self._due_s < self._timer.when():
            if self._timer is not None:
                self._timer.cancel()
            self._timer = self._loop.call_at(self._due_s, self._look)

    def _look(self) -> None:
        self._timer = None
        if self._due_s == float("inf"):
            return
        if self._loop.time() < self._due_s:
            self._timer = self._loop.call_at(self._due_s, self._look)
        else:
            self.abort()
