"""The breaker of a bundle: after too many overruns nothing is inferred until a probe says that it is fast again.

This module knows nothing about graphs, bots or threads: it counts, and says when a probe is due.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

__all__ = ["OVERRUNS", "PAUSES_NS", "Breaker", "Probe"]

OVERRUNS = 3  # in a row
PAUSES_NS = (100_000_000, 200_000_000, 500_000_000)
"""Before the first probe, the second, and all others: most overruns are over soon, and a slow bundle's probes cost."""


class Probe(NamedTuple):
    """What is to be run, and in how many µs it passes."""

    n_bots: int
    allowed_us: float


class Breaker:
    """Closed to begin with. `clock` counts ns and is monotonic.

    The thread that infers reports; another may probe. Each field is written by one of them at a time: nothing is
    reported while it is open, and no probe is due while it is closed.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._in_a_row: dict[str, int] = {}
        self._probe = Probe(1, 0.0)
        self._probe_at_ns = 0
        self._n_failed = 0  # probes, since it opened
        self.is_open = False
        self.n_opened = 0  # times, so far

    def report(self, graph: str, probe: Probe, *, overran: bool) -> None:
        """An inference for which a deadline left enough, by what is usual, has ended; `probe` would pass if it opened.

        Each graph counts for itself: the small one would hide for ever that the large one is slow.
        """
        self._in_a_row[graph] = self._in_a_row.get(graph, 0) + 1 if overran else 0
        if self._in_a_row[graph] < OVERRUNS or self.is_open:
            return
        self._probe, self._n_failed = probe, 0
        self._pause()
        self.n_opened += 1
        self.is_open = True

    def due(self) -> Probe | None:
        """The probe to run now, if any."""
        return self._probe if self.is_open and self._clock() >= self._probe_at_ns else None

    def probed(self, took_us: float) -> None:
        """A probe has ended. It closes the breaker, or another is due later."""
        if took_us <= self._probe.allowed_us:
            self._in_a_row.clear()
            self.is_open = False
        else:
            self._n_failed += 1
            self._pause()

    def _pause(self) -> None:
        self._probe_at_ns = self._clock() + PAUSES_NS[min(self._n_failed, len(PAUSES_NS) - 1)]
