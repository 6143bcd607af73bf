"""What bots would ask for, what it is worth and costs, and the order in which greedy considers it.

This module knows nothing about budgets or about what is chosen in the end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ranked", "Wishes", "density", "falling"]

_Bools = NDArray[np.bool_]
_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]


class Wishes(NamedTuple):
    """What N bots would ask for of I features each. All numbers are finite, costs are at least 0.

    A bot's call is paid once; it is 0 where a bot asks for nothing.
    """

    asked_NI: _Bools
    value_NI: _Floats
    costs_NI: _Floats
    calls_N: _Floats

    def worth_N(self, query_NI: _Bools) -> _Floats:
        """The values of a query, summed by bot."""
        return _row_sums(self.value_NI, query_NI)

    def us_N(self, query_NI: _Bools) -> _Floats:
        """What a query costs by bot, given that each bot with wishes asks for something in it."""
        return _row_sums(self.costs_NI, query_NI) + self.calls_N

    def only(self, query_NI: _Bools) -> Wishes:
        """The same bots asking for no more than this."""
        return self._replace(asked_NI=query_NI, calls_N=self.calls_N * query_NI.any(axis=1))

    def rows(self, bots: _Ints) -> Wishes:
        """The same for some of the bots."""
        return Wishes(self.asked_NI[bots], self.value_NI[bots], self.costs_NI[bots], self.calls_N[bots])

    def ranked(self) -> Ranked:
        """Each bot's features by falling density, in as many columns as the bot that asks for most of them needs."""
        density_NI = density(self.value_NI, self.costs_NI)
        places_NW = falling(density_NI, self.asked_NI)[:, : np.add.reduce(self.asked_NI, 1, np.int64).max()]
        places_NW += np.arange(0, density_NI.size, density_NI.shape[1])[:, None]
        asked_NW = self.asked_NI.take(places_NW)
        return Ranked(places_NW, asked_NW, self.costs_NI.take(places_NW) * asked_NW)


class Ranked(NamedTuple):
    """Features of N bots by falling density, and their flat places [N, I]. Cost is 0 where not asked for."""

    places_NW: _Ints
    asked_NW: _Bools
    costs_NW: _Floats

    def unranked(self, taken_NW: _Bools, like_NI: _Bools) -> _Bools:
        """What was taken, in the order and shape of `like_NI`."""
        chosen_NI = np.zeros(like_NI.shape, np.bool_)
        chosen_NI.reshape(-1)[self.places_NW] = taken_NW
        return chosen_NI


def density(value: _Floats, costs: _Floats) -> _Floats:
    """Value per µs, at least 0; infinite where something costs nothing."""
    per_us = value / costs
    np.maximum(per_us, 0.0, out=per_us)
    free = costs <= 0.0
    if free.any():
        per_us[free] = np.inf
    return per_us


def falling(worth: _Floats, asked: _Bools | None = None) -> _Ints:
    """Places along the last axis by falling worth, equal ones in their order; what is not asked for comes last.

    The bits of floats that are not negative sort like integers, and integers sort several times faster than places do
    by a stable sort: so the place travels in the lowest bits, for which worths that nearly equal count as equal.
    """
    size = worth.shape[-1]
    low = (1 << max(size - 1, 1).bit_length()) - 1
    key: _Ints = worth.view(np.int64) | low
    np.invert(key, out=key)
    if asked is not None and not asked.all():
        key ^= np.left_shift(~asked, 63, dtype=np.int64)
    key |= np.arange(size)
    key.sort(axis=-1)
    key &= low
    return key


def _row_sums(numbers_NI: _Floats, mask_NI: _Bools) -> _Floats:
    sums_N: _Floats = np.vecdot(numbers_NI, mask_NI)  # several times faster than a sum with a random `where`
    return sums_N
