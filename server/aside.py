"""Log lines written by a thread of their own: a pipe that nobody reads any more stops no bot.

This module knows nothing about what the lines say.
"""

from __future__ import annotations

import os
import queue
import select
import threading
from types import TracebackType

from server.logs import logger

__all__ = ["Aside"]

_END_S = 1.0  # most that ending waits for a reader

_log = logger("server.aside")


class Aside:
    """Takes lines at once, at most `limit` that are not written yet; a line beyond is lost, and their number is said
    by a line once there is room again. A context manager, at whose end what is left is written, if that takes no longer
    than a second.

    Writes to the descriptor itself: a thread caught in `sys.stderr`'s own lock would keep the interpreter from ending.
    """

    def __init__(self, descriptor: int, limit: int = 1000) -> None:
        self._descriptor = descriptor
        self._lines: queue.Queue[str | None] = queue.Queue(limit)
        self._n_lost = self._n_unwritten = 0  # for want of room; for an error of the descriptor's
        self._torn = False  # whether the last line ended in its middle
        self._writer = threading.Thread(target=self._write_on, name="log", daemon=True)
        self._writer.start()

    def __enter__(self) -> Aside:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            self._lines.put(None, timeout=_END_S)
        except queue.Full:
            return  # nobody reads, and who would wait for that never ends
        self._writer.join(_END_S)

    def isatty(self) -> bool:
        """Whether a terminal is at the other end."""
        return os.isatty(self._descriptor)

    def write(self, line: str) -> None:
        """Take a line; never waits."""
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self._n_lost += 1

    def _write_on(self) -> None:
        said = 0
        while (line := self._lines.get()) is not None:
            if not self._written(line):
                self._n_unwritten += 1
            elif (lost := self._n_lost + self._n_unwritten) > said:
                _log.warning("log lines lost", lines=lost - said)
                said = lost

    def _written(self, line: str) -> bool:
        """Whether the whole line is. A disk may be full for a while, a reader gone for good."""
        rest = (b"\n" if self._torn else b"") + line.encode(errors="backslashreplace")
        size = len(rest)
        while rest:
            try:
                rest = rest[os.write(self._descriptor, rest) :]
            except BlockingIOError:  # whose descriptor it is too has made it so
                select.select([], [self._descriptor], [])
            except OSError:
                self._torn = self._torn or len(rest) < size
                return False
        self._torn = False
        return True
