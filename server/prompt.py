"""uvicorn's HTTP protocol with what it lacks: clients that dawdle over a request's head or do not take replies go.

This module knows nothing about what is served. uvicorn's own timer runs between requests alone: a socket that sends
nothing after connecting, or its head a byte at a time, stays open for as long as its client likes.
"""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

__all__ = ["PromptHttp", "prompt_http"]

_MAX_HEAD_BYTES = 65536


class PromptHttp(HttpToolsProtocol):
    """A socket of the HTTP door. `deadline_s` counts from connecting, from a head's first byte, and from a reply that
    the client has no room for.
    """

    def __init__(self, *args: Any, deadline_s: float, **named: Any) -> None:
        super().__init__(*args, **named)
        self._deadline_s = deadline_s
        self._head_timer: asyncio.TimerHandle | None = None
        self._reader_timer: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._is_upgraded = False
        self._running: RequestResponseCycle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """See asyncio.Protocol."""
        super().connection_made(transport)
        self._expect_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._forget_answer()  # uvicorn tells the last of several pipelined requests only
        super().connection_lost(exc)
        _cancel(self._head_timer)
        self._head_timer = None
        _cancel(self._reader_timer)
        self._reader_timer = None

    def data_received(self, data: bytes) -> None:
        """See asyncio.Protocol."""
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


def prompt_http(deadline_s: float) -> Any:
    """The protocol as uvicorn's Config takes it."""
    return partial(PromptHttp, deadline_s=deadline_s)
