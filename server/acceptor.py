"""Acceptor: clients of a listening socket are let in one after the other, at a pace that those inside do not feel.

This module knows nothing about protocols. The event loop's own servers accept whoever waits in one go: hundreds that
come at once, and whatever each begins with, hold up all others. The system keeps them waiting as well as we could.
"""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable

from server.logs import logger

__all__ = ["Acceptor"]

_FULL = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_PACE_S = 0.001  # from one to the next, in which whoever is inside has a turn
_REST_S = 1.0  # until it is tried again when the system has no room for a socket: it would fail as often as asked
_log = logger(__name__)


class Acceptor:
    """Gives each client of `listening`, which does not block and is closed with this, a protocol that `make` makes.

    It closes and waits as an asyncio.Server does. The event loop's thread alone may use it.
    """

    def __init__(self, listening: socket.socket, make: Callable[[], asyncio.BaseProtocol]) -> None:
        self._listening = listening
        self._make = make
        self._loop = asyncio.get_running_loop()
        self._pause: asyncio.TimerHandle | None = None  # until the next one may come
        self._joining: set[asyncio.Task[None]] = set()
        self._listen()

    def close(self) -> None:
        """Let nobody else in. Whoever still waits is reset by the system."""
        if self._listening.fileno() < 0:
            return
        if self._pause is None:
            self._loop.remove_reader(self._listening)
        else:
            self._pause.cancel()
        self._listening.close()

    async def wait_closed(self) -> None:
        """Until whoever was let in has a protocol."""
        if self._joining:
            await asyncio.wait(self._joining)

    def _listen(self) -> None:
        self._pause = None
        self._loop.add_reader(self._listening, self._accept)

    def _pause_for(self, seconds: float) -> None:
        self._loop.remove_reader(self._listening)
        self._pause = self._loop.call_later(seconds, self._listen)

    def _accept(self) -> None:
        try:
            client, _ = self._listening.accept()
        except (BlockingIOError, InterruptedError, ConnectionAbortedError):
            return  # it has left in the meantime
        except OSError as error:
            if error.errno not in _FULL:
                raise
            _log.error("no room for another socket", error=str(error), retry_after_s=_REST_S)
            self._pause_for(_REST_S)
            return
        self._pause_for(_PACE_S)
        client.setblocking(False)
        joining = self._loop.create_task(self._join(client))
        self._joining.add(joining)
        joining.add_done_callback(self._joining.discard)

    async def _join(self, client: socket.socket) -> None:
        try:
            await self._loop.connect_accepted_socket(self._make, client)
        except OSError:  # it has left in the meantime
            client.close()
