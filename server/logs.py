"""Logs: one line an event, as JSON or for a person's eyes, and never more lines than can be read.

This module knows nothing about what is logged. Every part logs by the standard library or by `logger`, which adds named
values to a line; nothing logs a frame. What a line may not hold is what could be used: tokens, and whole names of
connections, of which `digest` gives as much as tells them apart.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from typing import Protocol

import structlog
from structlog.typing import Processor

__all__ = ["Flood", "Lines", "configure", "digest", "logger"]

_MAX_EVENTS = 256


def logger(name: str) -> structlog.stdlib.BoundLogger:
    """Logs events with named values: `logger(__name__).info("connection opened", transport="tcp")`.

    It hands on to the standard library's logger of this name, so it needs no set-up of its own.
    """
    wrapped: structlog.stdlib.BoundLogger = structlog.wrap_logger(
        logging.getLogger(name),
        processors=[structlog.stdlib.filter_by_level, structlog.stdlib.render_to_log_kwargs],
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    return wrapped


def digest(secret: str) -> str:
    """Eight hexadecimal digits of the hash of a connection's name: tells connections apart, and opens none."""
    return hashlib.sha256(secret.encode()).hexdigest()[:8]


class Lines(Protocol):
    """Where lines go: a text file, or `server.aside.Aside`."""

    def isatty(self) -> bool: ...
    def write(self, line: str, /) -> object: ...


def configure(as_json: bool | None, stream: Lines) -> None:
    """Log everything from INFO on to `stream`; None: as JSON unless a person is watching it."""
    if as_json is None:
        as_json = not stream.isatty()
    shared: list[Processor] = [
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    last: list[Processor] = [structlog.stdlib.ProcessorFormatter.remove_processors_meta]
    if as_json:
        last += [structlog.processors.format_exc_info, structlog.processors.JSONRenderer(default=str)]
    else:
        plain = structlog.dev.plain_traceback
        last += [structlog.dev.ConsoleRenderer(colors=stream.isatty(), exception_formatter=plain)]
    handler = logging.StreamHandler(stream)
    handler.addFilter(Flood())
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=last))
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)  # the server says itself when it starts and ends


class Flood(logging.Filter):
    """Lets pass `limit` lines of one event in `window_s`; the first of a later window says how many did not.

    What a client can bring about again and again would else fill a disk. `clock` counts seconds.
    """

    def __init__(self, limit: int = 20, window_s: float = 10.0, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._limit, self._window_s, self._clock = limit, window_s, clock
        self._windows: dict[tuple[str, str], tuple[float, int]] = {}  # by event: when it began, lines that came

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether this line passes."""
        event, now_s = (record.name, str(record.msg)), self._clock()
        begun_s, came = self._windows.get(event, (now_s, 0))
        if now_s - begun_s >= self._window_s:
            if came > self._limit:
                record.suppressed = came - self._limit
            begun_s, came = now_s, 0
        if event not in self._windows and len(self._windows) == _MAX_EVENTS:
            del self._windows[next(iter(self._windows))]
        self._windows[event] = (begun_s, came + 1)
        return came < self._limit
