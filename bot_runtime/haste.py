"""Whether there is time to infer: how long each graph takes by the number of bots, and the breaker.

This module knows nothing about what is inferred or what happens instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from bot_runtime.breaker import Breaker, Probe
from bot_runtime.deadline import Deadline
from bot_runtime.durations import Durations
from bot_runtime.fallback import Cause

__all__ = ["Haste"]

# A deadline that leaves less than twice what is usual is its engine's own risk: an overrun of it opens no breaker, and
# what takes twice what is usual, by its processor time, is slow enough to keep one open.
_USUAL_SHARE = 2.0


class Haste:
    """What is known of one bundle's speed. `clock` counts ns and is monotonic."""

    def __init__(self, clock: Callable[[], int]) -> None:
        self.breaker = Breaker(clock)
        self._took = {"query_probs": Durations(clock), "act": Durations(clock)}

    def cause_against(self, deadline: Deadline | None, n_bots: int, *graphs: str) -> Cause | None:
        """Why these graphs are not to be run for so many bots now, if they are not."""
        if self.breaker.is_open:
            return Cause.BREAKER
        if deadline is None:
            return None
        predicted_us = sum(self._took[graph].predicted_us(n_bots) for graph in graphs)
        return Cause.SHED if deadline.left_us() < predicted_us else None

    def observe(self, graph: str, n_bots: int, took_us: float) -> None:
        """A graph has run."""
        self._took[graph].observe(n_bots, took_us)

    def settle(self, deadline: Deadline, n_bots: int, allowed_us: float, took_us: float, *graphs: str) -> bool:
        """Whether what was inferred may be answered. `allowed_us` is what the deadline left when it began.

        An answer may be too late though its graphs were quick: the event loop's timer was early, or the machine busy.
        That says nothing about the bundle, and would open the breakers of all of them under load.
        """
        usual_us = self._usual_us(n_bots, graphs)
        if usual_us is not None and allowed_us >= _USUAL_SHARE * usual_us:
            whole_us = self._usual_us(n_bots, self._took) or 0.0  # a probe runs both graphs, whichever was slow
            passes_us = max(allowed_us, _USUAL_SHARE * whole_us)
            self.breaker.report(graphs[-1], Probe(n_bots, passes_us), overran=took_us > allowed_us)
        return deadline.take()

    def _usual_us(self, n_bots: int, graphs: Iterable[str]) -> float | None:
        usual_us = [self._took[graph].usual_us(n_bots) for graph in graphs]
        return None if None in usual_us else sum(filter(None, usual_us))
