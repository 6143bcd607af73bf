"""Names: numbers that bots keep for as long as their client lives, and the handles that they have now.

This module knows nothing about connections or why handles change.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.errors import NoBot
from protocol.packing import handles_of

__all__ = ["Names"]


class Names:
    """Bots by number, from 0; no number is used twice. `now` are their handles."""

    def __init__(self) -> None:
        self.now: dict[int, int] = {}
        self._next = 0

    def add(self, handles_N: NDArray[np.int64]) -> range:
        """Numbers of new bots."""
        numbers = range(self._next, self._next + handles_N.size)
        self._next = numbers.stop
        self.now.update(zip(numbers, handles_N.tolist(), strict=True))
        return numbers

    def known(self, bots: ArrayLike) -> list[int]:
        """These numbers. Raises NoBot where there is no such bot, BadSchema for floats."""
        numbers = handles_of(bots)
        for number in numbers:
            if number not in self.now:
                raise NoBot(f"no bot {number} of this client")
        return numbers

    def handles(self, numbers: Sequence[int]) -> list[int]:
        """What these bots are called by the server now."""
        return [self.now[number] for number in numbers]

    def forget(self, numbers: Sequence[int]) -> None:
        """These have ended."""
        for number in numbers:
            del self.now[number]
