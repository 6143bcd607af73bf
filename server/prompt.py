"""uvicorn's HTTP protocol with what it lacks: clients that are too many, dawdle over a head or take no replies go.

This module knows nothing about what is served. uvicorn's own timer runs between requests alone: a socket that sends
nothing after connecting, or its head a byte at a time, stays open for as long as its client likes.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from protocol.codec import Format
from protocol.errors import TooManyConnections
from server.answer import refusal
from server.crowd import Crowd
from server.recorder import Recorder

__all__ = ["PromptHttp", "prompt_http"]

_MAX_HEAD_BYTES = 65536


class PromptHttp(HttpToolsProtocol):
    """A socket of the HTTP door. `deadline_s` counts from connecting, from a head's first byte, and from a reply that
    the client has no room for. One that the `crowd` has no place for is answered at once, whatever it would ask.
    """

    def __init__(self, *args: Any, deadline_s: float, crowd: Crowd, recorder: Recorder, **named: Any) -> None:
        super().__init__(*args, **named)
        self._deadline_s = deadline_s
        self._crowd, self._recorder = crowd, recorder
        self._has_place = False
        self._head_timer: asyncio.TimerHandle | None = None
        self._reader_timer: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._is_upgraded = False
        self._running: RequestResponseCycle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio.Protocol."""
        super().connection_made(transport)
        try:
            self._crowd.enter()
        except TooManyConnections as error:
            self._recorder.refused("http", error.code)
            transport.write(_turned_away(error))
            transport.close()
            return
        self._has_place = True
        self._expect_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._forget_answer()  # uvicorn tells the last of several pipelined requests only
        super().connection_lost(exc)
        if self._has_place:
            self._crowd.leave()
        _cancel(self._head_timer)
        self._head_timer = None
        _cancel(self._reader_timer)
        self._reader_timer = None

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol."""
        if not self._has_place:
            return
        super().data_received(data)
        between = self.cycle is None or self.cycle.response_complete
        if between and not self._is_upgraded and self.timeout_keep_alive_task is None:
            self._head_bytes += len(data)
            if self._head_bytes > _MAX_HEAD_BYTES:
                self._abort()
            elif self._head_timer is None:
                self._expect_head()

    def on_headers_complete(self) -> None:
        """See httptools."""
        _cancel(self._head_timer)
        self._head_timer = None
        self._head_bytes = 0
        super().on_headers_complete()

    def handle_websocket_upgrade(self) -> None:
        """See HttpToolsProtocol: from now on the socket is another protocol's."""
        self._is_upgraded = True
        super().handle_websocket_upgrade()

    def pause_writing(self) -> None:
        """See asyncio.Protocol."""
        super().pause_writing()
        self._reader_timer = self.loop.call_later(self._deadline_s, self._abort)

    def resume_writing(self) -> None:
        """See asyncio.Protocol."""
        super().resume_writing()
        _cancel(self._reader_timer)
        self._reader_timer = None

    def timeout_keep_alive_handler(self) -> None:
        """See HttpToolsProtocol, which would wait for the client to read what it was sent."""
        self._abort()

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def _expect_head(self) -> None:
        self._head_timer = self.loop.call_later(self._deadline_s, self._abort)

    def _abort(self) -> None:
        self._forget_answer()
        self.transport.abort()

    def _forget_answer(self) -> None:
        """Whoever is still answering must not write to a socket that has closed."""
        if self._running is not None:
            self._running.disconnected = True
            self._running.message_event.set()


def _cancel(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()


def _turned_away(error: TooManyConnections) -> bytes:
    """In msgpack, as engines read it: what would have been asked for, and in which format, has not come yet."""
    answered = refusal(error, Format.MSGPACK)
    head = f"HTTP/1.1 503 Service Unavailable\r\nContent-Type: {Format.MSGPACK.value}\r\nRetry-After: 1\r\n"
    return f"{head}Content-Length: {len(answered.body)}\r\nConnection: close\r\n\r\n".encode() + answered.body


def prompt_http(deadline_s: float, crowd: Crowd, recorder: Recorder) -> Any:
    """The protocol as uvicorn's Config takes it."""
    return partial(PromptHttp, deadline_s=deadline_s, crowd=crowd, recorder=recorder)
