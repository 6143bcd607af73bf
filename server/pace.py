"""Pace: how long requests of one bundle take, so that what is quick need not leave the event loop.

This module knows nothing about what a request does, or who waits for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from bot_runtime.durations import Durations
from protocol.messages import Request

__all__ = ["Kind", "Pace"]

Kind = tuple[type[Request], int]  # and the number of bits in its number of bots: sizes within a factor of two


class Pace:
    """How long requests take, by kind and size: what the longest of the last few took, in µs.

    One odd measurement at most doubles an estimate; it takes ten good ones to take that back. Beside it, how long the
    work took as a whole, which says when those behind it have their turn. `clock` counts ns; from any thread.
    """

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._us: dict[Kind, float] = {}
        self._clock = clock
        self._wholes: dict[type[object], Durations] = {}

    def expected_us(self, kind: Kind) -> float:
        """What the next one is expected to take; infinite before the first."""
        return self._us.get(kind, float("inf"))

    def observe(self, kind: Kind, took_us: float) -> None:
        """One has taken so long."""
        known_us = self._us.get(kind)
        if known_us is None:
            self._us[kind] = took_us
        else:
            self._us[kind] = min(2.0 * known_us, took_us) if took_us > known_us else 0.93 * known_us

    def whole_us(self, kind: type[object], size: int) -> float:
        """The mean of what work of this kind and size took lately, all in all; 0 where nothing is known."""
        return self._wholes[kind].mean_us(size) if kind in self._wholes else 0.0

    def observe_whole(self, kind: type[object], size: int, took_us: float) -> None:
        """Work has taken so long, waiting for the machine included."""
        self._wholes.setdefault(kind, Durations(self._clock)).observe(size, took_us)
