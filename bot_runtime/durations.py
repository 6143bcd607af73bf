"""How long work of a size takes, from what it took lately: a median to plan by, a mean to add up, and what is usual.

This module knows nothing about what the work is. Sizes that share a power of two share what is known of them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from statistics import fmean

__all__ = ["Durations"]

_RECENT = 32  # measurements that a prediction is made of
_RECENT_NS = 10**9  # what is older says nothing of the machine as it is now, and a stall must be forgotten
_USUAL_STEP = 1.02  # a median that follows by 2 % a measurement: one outlier moves it no more than that


class Durations:
    """Measured µs by size. `clock` counts ns, is monotonic, and says when something was measured.

    One thread at a time observes; any may ask meanwhile.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._by_magnitude: dict[int, _Measured] = {}

    def observe(self, size: int, us: float) -> None:
        """What work of this size has just taken."""
        measured = self._by_magnitude.get(size.bit_length())
        if measured is None:
            measured = self._by_magnitude[size.bit_length()] = _Measured(us)
        measured.add(self._clock(), us)

    def predicted_us(self, size: int) -> float:
        """The median of the last second, of this size or, where there was none, a smaller one.

        What is more likely than not to be in time is to be tried, for an overrun has a fallback too: on a machine that
        others use as well, nine in ten would take many times as long. 0 where nothing was measured lately: then only
        trying tells.
        """
        recent = self._recent(size)
        return sorted(recent)[len(recent) // 2] if recent else 0.0

    def mean_us(self, size: int) -> float:
        """The same, but the mean: of several that are done one after the other, each may be the one that takes long."""
        recent = self._recent(size)
        return fmean(recent) if recent else 0.0

    def usual_us(self, size: int) -> float | None:
        """The median of all that was ever measured of this size; None where nothing was."""
        measured = self._by_magnitude.get(size.bit_length())
        return None if measured is None else measured.usual_us

    def _recent(self, size: int) -> list[float]:
        now_ns = self._clock()
        for magnitude in range(size.bit_length(), -1, -1):
            measured = self._by_magnitude.get(magnitude)
            recent = measured.recent(now_ns) if measured is not None else []
            if recent:
                return recent
        return []


class _Measured:
    """What is known of one magnitude."""

    def __init__(self, us: float) -> None:
        self.usual_us = us
        self._recent: deque[tuple[int, float]] = deque(maxlen=_RECENT)

    def add(self, now_ns: int, us: float) -> None:
        self.usual_us *= _USUAL_STEP if us > self.usual_us else 1 / _USUAL_STEP
        self._recent.append((now_ns, us))

    def recent(self, now_ns: int) -> list[float]:
        """Looked through here: every turn is measured, and only those with a deadline ask."""
        return [us for at_ns, us in tuple(self._recent) if now_ns - at_ns <= _RECENT_NS]
