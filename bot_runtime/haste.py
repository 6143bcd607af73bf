"""Whether there is time to infer: how long each graph takes by the number of bots, and the breaker.

This module knows nothing about what is inferred or what happens instead.
"""

from __future__ import annotations

from collections.abc import Callable

from bot_runtime.breaker import Breaker
from bot_runtime.deadline import Deadline
from bot_runtime.durations import Durations
from bot_runtime.fallback import Cause

__all__ = ["Haste"]

# A deadline that leaves less than twice what is usual is its engine's own risk: an overrun of it opens no breaker.
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

    def settle(self, deadline: Deadline, n_bots: int, allowed_us: float, *graphs: str) -> bool:
        """Whether what was inferred may be answered. `allowed_us` is what the deadline left when it began."""
        in_time = deadline.take()
        usual_us = [self._took[graph].usual_us(n_bots) for graph in graphs]
        if all(us is not None for us in usual_us) and allowed_us >= _USUAL_SHARE * sum(filter(None, usual_us)):
            self.breaker.report(graphs[-1], n_bots, allowed_us, overran=not in_time)
        return in_time
