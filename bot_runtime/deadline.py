"""A request's deadline: when its answer must have left, and which of two threads gives that answer.

This module knows nothing about messages, sockets or bots. Inference cannot be interrupted. So before it begins, the
thread that runs it offers what is to be answered if it takes too long; whoever waits may take that offer when the time
is up, and the thread learns at the end that it was taken, and commits what has left instead of what it computed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from protocol.errors import NotReady

__all__ = ["LEAVE_US", "Deadline"]

LEAVE_US = 300.0  # what an answer takes to be written and handed to its socket, kept back of every deadline


class Deadline:
    """One request's. `due_ns` is on the scale of `clock`, which is monotonic; `limit_us` is what was asked for.

    `offer`, `left_us` and `take` are for the thread that does the work, `expire` for the one that waits.
    """

    def __init__(self, received_ns: int, limit_us: float, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self.limit_us = limit_us
        self.due_ns = received_ns + int(limit_us * 1e3)
        self.fallback: Any = None
        self._clock = clock
        self._lock = threading.Lock()
        self._answered = False

    def left_us(self) -> float:
        """What is left for the work itself; negative when it is too late."""
        return (self.due_ns - self._clock()) / 1e3 - LEAVE_US

    @property
    def is_over(self) -> bool:
        """Whether the deadline itself has passed."""
        return self._clock() > self.due_ns

    def offer(self, fallback: object) -> None:
        """From here on this may be answered instead, and nothing may be refused any more.

        Raises NotReady when the request was refused already because it was not begun in time: change nothing then.
        """
        with self._lock:
            if self._answered:
                raise NotReady("the deadline passed before the request was begun", retry_after_s=0.1)
            self.fallback = fallback

    def take(self) -> bool:
        """Whether what was computed may be answered: it is not too late, and the fallback has not left."""
        with self._lock:
            lost, self._answered = self._answered, True
        return not lost and self.left_us() >= 0.0

    def expire(self) -> bool:
        """Answer now with `fallback`, or refuse where it is None; False when the answer is on its way already."""
        with self._lock:
            lost, self._answered = self._answered, True
        return not lost
