"""Vigil: an event loop that stays awake for a while after each answer, for the next request may be near.

This module knows nothing about requests. To wake a process that sleeps takes the kernel, and the caches that others
have used meanwhile, longer than a small turn takes; a server with a core of its own need not sleep within a turn.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable

__all__ = ["Vigil"]


class Vigil:
    """Keeps the running event loop polling for `spin_us` after each `begin`, or not at all. `clock` counts ns."""

    def __init__(self, spin_us: float, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._spin_ns = int(spin_us * 1e3)
        self._clock = clock
        self._until_ns = 0
        self._is_awake = False

    def begin(self) -> None:
        """Stay awake from now on, for so long."""
        if not self._spin_ns:
            return
        self._until_ns = self._clock() + self._spin_ns
        if not self._is_awake:
            self._is_awake = True
            asyncio.get_running_loop().call_soon(self._watch)

    def _watch(self) -> None:
        """A round of the event loop that has something to do does not sleep before the next."""
        self._is_awake = self._clock() < self._until_ns
        if self._is_awake:
            os.sched_yield()  # to a client that has no other core
            asyncio.get_running_loop().call_soon(self._watch)
