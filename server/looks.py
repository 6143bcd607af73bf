"""Looks: the event loop's looks at its sockets, and the line of what waits for the next one.

This module knows nothing about requests or sockets. What is answered on the event loop holds up all that it would read
or write meanwhile. So one job has its turn between two looks, and others wait: what came meanwhile is read, learns at
once whether it can be served at all, and counts as received not much later than it came.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable

__all__ = ["Looks"]

_AWAKE_NS = 500_000  # from the end of a look to the next, where the event loop did not sleep in between


class Looks:
    """The event loop's thread alone may use it. `clock` counts ns and is monotonic.

    `afterwards` is called after a look in which nothing waited any more, once its answers on streams have left.
    """

    def __init__(
        self, clock: Callable[[], int] = time.monotonic_ns, afterwards: Callable[[], object] = lambda: None
    ) -> None:
        self._clock = clock
        self._afterwards = afterwards
        self._waiting: deque[tuple[Callable[[], None], float]] = deque()
        self.backlog_us = 0.0  # what the jobs that wait will take, by what was expected of them
        self._is_taken = self._is_ending = False
        self._first_ns: int | None = None  # when the first request of this look was read
        self._began_ns = 0  # when anything was known of this look, with a deadline or without
        self._since_ns = self._last_ns = self._ended_ns = 0

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def is_free(self) -> bool:
        """Whether a job may have its turn now: this look has had none, and none waits."""
        return not (self._is_taken or self._waiting)

    def take(self) -> None:
        """A job has its turn in this look."""
        self._is_taken = True
        self._expect_end()

    def put(self, job: Callable[[], None], expected_us: float) -> None:
        """Do this in the order of the line. It takes its turn (`take`), or leaves it to the next."""
        self._waiting.append((job, expected_us))
        self.backlog_us += expected_us
        self._expect_end()

    def since_ns(self, received_ns: int) -> int:
        """Since when what was read now may have been there.

        What is found at a look may have been there since shortly after the one before, so it counts from then, unless
        the event loop has slept since.
        """
        if self._first_ns is None:
            has_slept = received_ns - self._ended_ns > _AWAKE_NS
            self._since_ns = received_ns if has_slept else self._last_ns
            self._first_ns = received_ns
            self._expect_end()
        return self._since_ns

    def _expect_end(self) -> None:
        if not self._is_ending:
            self._is_ending = True
            self._began_ns = self._clock()
            asyncio.get_running_loop().call_soon(self._end)

    def _end(self) -> None:
        """All that this look found was read; before the next, whoever is first in the line."""
        self._is_ending = self._is_taken = False
        self._last_ns = self._began_ns if self._first_ns is None else self._first_ns
        self._first_ns = None
        if not self._waiting:
            asyncio.get_running_loop().call_soon(self._afterwards)  # behind the answers of those that waited
        while self._waiting and not self._is_taken:
            job, expected_us = self._waiting.popleft()
            self.backlog_us = self.backlog_us - expected_us if self._waiting else 0.0
            job()
        if self._waiting:
            self._expect_end()
        self._ended_ns = self._clock()
