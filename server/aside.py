"""Log lines written by a thread of their own: a pipe that nobody reads any more stops no bot.

This module knows nothing about what the lines say.
"""

from __future__ import annotations

import os
import queue
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
        self._n_lost = 0
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
            try:
                rest = line.encode(errors="backslashreplace")
                while rest:
                    rest = rest[os.write(self._descriptor, rest) :]
            except OSError:  # whoever read is gone for good: there is nobody to tell
                continue
            if (lost := self._n_lost) > said:
                _log.warning("log lines lost", lines=lost - said)
                said = lost
