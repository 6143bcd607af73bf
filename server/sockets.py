"""The open sockets of every door that keeps one connection a socket: how many there may be, and how they are drained.

This module knows nothing about what travels on them.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import Protocol

from protocol.errors import TooManyConnections
from server.brake import Brake
from server.desk import Desk
from server.vigil import Vigil

__all__ = ["Sockets"]


class _Open(Protocol):
    @property
    def name(self) -> str:
        """The transport's, as in Arrival."""

    @property
    def is_busy(self) -> bool:
        """Whether a request of it is being answered."""

    def finish(self) -> None:
        """Close as soon as what was written has left."""

    def abort(self) -> None:
        """Close at once."""


class Sockets:
    """At most `max_sockets` at a time, all asking at one desk.

    A socket closes when its client does, after `idle_ttl_s` of silence between requests, and after `frame_deadline_s`
    of a request that does not end, a reply that is not taken, or a hello that does not come. `brake` and `vigil`, which
    keeps the event loop awake for `spin_us` after an answer, are every door's.
    """

    def __init__(
        self, desk: Desk, *, max_sockets: int, frame_deadline_s: float, idle_ttl_s: float, spin_us: float = 0.0
    ) -> None:
        self.desk = desk
        self.frame_deadline_s = frame_deadline_s
        self.idle_ttl_s = idle_ttl_s
        self.draining = False
        self.brake = Brake()
        self.vigil = Vigil(spin_us)
        self._max_sockets = max_sockets
        self._open: set[_Open] = set()
        self._emptied = asyncio.Event()

    def __len__(self) -> int:
        return len(self._open)

    def by_transport(self) -> dict[str, int]:
        """How many there are, by the transport's name."""
        return dict(Counter(socket.name for socket in tuple(self._open)))

    def add(self, socket: _Open) -> None:
        """One more is open; raises TooManyConnections."""
        if len(self._open) >= self._max_sockets:
            raise TooManyConnections(f"all {self._max_sockets} sockets are taken", retry_after_s=1.0)
        self._open.add(socket)

    def remove(self, socket: _Open) -> None:
        """It has closed; also one that was never added."""
        self._open.discard(socket)
        if not self._open:
            self._emptied.set()

    async def drain(self, timeout_s: float) -> None:
        """Close the sockets that no whole request came from, let requests in progress be answered, close the rest.

        Waits for at most `timeout_s`.
        """
        self.draining = True
        for socket in tuple(self._open):
            if not socket.is_busy:
                socket.finish()
        self._emptied.clear()
        if self._open:
            try:
                async with asyncio.timeout(timeout_s):
                    await self._emptied.wait()
            except TimeoutError:
                for socket in tuple(self._open):
                    socket.abort()
