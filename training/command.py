"""How a command ends: what its user can mend is said in one line, and what it has begun to write does not stay.

This module knows nothing about what commands do.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from protocol.errors import ProtocolError

__all__ = ["command", "terminable"]


@contextmanager
def command(stopped: str = "stopped") -> Iterator[None]:
    """Around all that a command does: what its arguments, its files or a bundle have wrong becomes `error: ...` and
    exit status 1, Ctrl-C becomes `stopped`. `python -X dev -m ...` shows where an error came from instead."""
    try:
        yield
    except (ValueError, OSError, ProtocolError) as error:
        if sys.flags.dev_mode:
            raise
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(stopped)


@contextmanager
def terminable() -> Iterator[None]:
    """SIGTERM, by which Docker and clusters stop a process, ends it as an exception would: what is written to a scratch
    folder is removed. Only in the main thread."""

    def end(number: int, _: object) -> None:
        sys.exit(128 + number)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
