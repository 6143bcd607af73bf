"""Which row groups are in memory at an update. This module knows nothing about files or numbers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["Rota"]

_ORDER = 1  # tells the chance of the order from that of an update


@dataclass(frozen=True)
class Rota:
    """Groups come by one after another, in an order that is drawn anew each time that all have come by. A position
    counts them as they come. Where all are in memory at once they stay, in their own order."""

    n_groups: int
    n_slots: int  # groups in memory
    updates: int  # until the next one comes in, and the one that has been there longest goes
    seed: int

    def positions(self, update: int) -> range:
        """Positions that are in memory at an update."""
        first = 0 if self.n_slots == self.n_groups else update // self.updates
        return range(first, first + self.n_slots)

    def group(self, position: int) -> int:
        """The group that is at a position."""
        if self.n_slots == self.n_groups:
            return position
        time, i = divmod(position, self.n_groups)
        return int(_order(self.seed, time, self.n_groups)[i])


@lru_cache(maxsize=4)
def _order(seed: int, time: int, n_groups: int) -> NDArray[np.int64]:
    return np.random.default_rng([seed, time, _ORDER]).permutation(n_groups)
