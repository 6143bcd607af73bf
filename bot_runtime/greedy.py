"""The greedy choice: which features to ask for when not all of them fit, by value per µs.

This module knows nothing about budgets' margins, bots or networks. It solves knapsacks, one a bot or one for all bots,
as Dantzig did: in the order of value per µs, skipping what does not fit. Of features of value v and cost c:

- *A bot's own limit* (`fit_rows`). Whatever is asked for pays the call, so what is left of the limit is a plain
  knapsack. Up to the first feature that does not fit, greedy is what the linear relaxation takes, and with the part of
  that feature that would fit it is the relaxation's optimum, which is at least the true optimum OPT. So greedy is worth
  OPT - max v at least; and where one feature alone is worth more it is taken instead, which makes the worth OPT / 2 at
  least (Kellerer, Pferschy and Pisinger, *Knapsack Problems*, 2004, section 2.1).
- *A limit that bots share* (`fit_frame`). A bot's first feature costs its call too. In the order of v / c, a bot's
  features are worth the most per µs, call included, up to some feature: those are its *opening*, and all count as worth
  that much per µs. Later ones count v / c, which is no more than that. So the order of these slopes follows the concave
  hull of what each bot can be worth by its cost, and greedy is again the linear relaxation (ibid., section 11.2, the
  multiple-choice knapsack) up to the first opening or feature that does not fit: it is worth OPT - max(v, an opening's
  worth) at least, without calls OPT - max v. Where one feature or one bot alone is worth more, that is taken instead:
  OPT / 2 at least, given that there are no calls or that what each bot asks for would fit if it were alone.

Slopes that differ by less than a 2^-26th count as equal, and the bounds hold but for that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bot_runtime.wishes import Ranked, Wishes, density, falling

__all__ = ["MAX_PASSES", "fit_frame", "fit_rows"]

# Each pass drops at least every feature of one cost, and a cost table has few distinct costs; a table of a thousand
# different ones may end early, which only leaves budget unspent.
MAX_PASSES = 64
_BLOCK = 512
_LARGEST = np.finfo(np.float64).max

_Bools = NDArray[np.bool_]
_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]


def fit_rows(wishes: Wishes, limits_N: _Floats) -> _Bools:
    """What each bot may ask for within its own limit: all, where that fits."""
    asked_NI = wishes.asked_NI
    if np.isposinf(limits_N).all():
        return asked_NI
    tight = np.flatnonzero(~(wishes.totals_N() <= limits_N) & asked_NI.any(axis=1))
    if tight.size == 0:
        return asked_NI
    rows, limits_R = wishes.rows(tight), limits_N[tight]
    fitted_NI = asked_NI.copy()
    fitted_NI[tight] = _single_if_better(_greedy_rows(rows, limits_R), rows, limits_R)
    return fitted_NI


def fit_frame(wishes: Wishes, limit: float) -> _Bools:
    """What all bots together may ask for within one limit: all, where that fits."""
    asked_NI, totals_N = wishes.asked_NI, wishes.totals_N()
    if totals_N.sum() <= limit or not asked_NI.any():
        return asked_NI
    if limit < 0.0:
        return np.zeros_like(asked_NI)
    if wishes.calls_N.any():
        chosen_NI = _greedy_with_calls(wishes, limit)
    else:
        frame = _Frame(asked_NI, wishes.costs_NI, wishes.calls_N, limit)
        places_K = np.flatnonzero(asked_NI)
        frame.run(places_K[falling(density(wishes.value_NI.take(places_K), wishes.costs_NI.take(places_K)))])
        places_K = frame.fitting()
        frame.fill(places_K[falling(density(wishes.value_NI.take(places_K), wishes.costs_NI.take(places_K)))])
        chosen_NI = frame.taken_NW
    return _alone_if_better(chosen_NI, wishes, totals_N, limit)


def _greedy_rows(wishes: Wishes, limits_R: _Floats) -> _Bools:
    """Greedy with skips in every row at once, a run of fitting features at a time.

    Each pass takes the longest run of the densest candidates that fits, then drops what can no longer fit: the first
    feature after the run at least.
    """
    ranked = wishes.ranked()
    left_RW, costs_RW = ranked.asked_NW.copy(), ranked.costs_NW
    limits_R1, spent_R1 = limits_R[:, None], wishes.calls_N[:, None]
    taken_RW = np.zeros_like(left_RW)
    for _ in range(MAX_PASSES):
        left_RW &= spent_R1 + costs_RW <= limits_R1
        if not left_RW.any():
            break
        running_RW = costs_RW * left_RW
        np.cumsum(running_RW, axis=1, out=running_RW)
        running_RW += spent_R1
        fits_RW = running_RW <= limits_R1
        last_R1 = fits_RW.sum(axis=1)[:, None] - 1
        spent_R1 = np.where(last_R1 < 0, spent_R1, np.take_along_axis(running_RW, last_R1, axis=1))
        fits_RW &= left_RW
        taken_RW |= fits_RW
        left_RW ^= fits_RW
    return ranked.unranked(taken_RW, wishes.asked_NI)


def _single_if_better(chosen_RI: _Bools, wishes: Wishes, limits_R: _Floats) -> _Bools:
    """The choice; or in rows where one feature that fits is worth more, that one."""
    fits_RI = wishes.asked_NI & (wishes.costs_NI + wishes.calls_N[:, None] <= limits_R[:, None])
    single_RI = np.where(fits_RI, wishes.value_NI, -np.inf)
    best_R = single_RI.argmax(axis=1)
    rows_R = np.arange(best_R.size)
    better = np.flatnonzero(single_RI[rows_R, best_R] > wishes.worth_N(chosen_RI))
    chosen_RI[better] = False
    chosen_RI[better, best_R[better]] = True
    return chosen_RI


def _alone_if_better(chosen_NI: _Bools, wishes: Wishes, totals_N: _Floats, limit: float) -> _Bools:
    """The choice; or one feature, or all that one bot asks for, where that fits and is worth more."""
    asked_NI, worth = wishes.asked_NI, wishes.worth_N(chosen_NI).sum()
    if wishes.value_NI.max() * asked_NI.shape[1] <= worth:
        return chosen_NI
    fits_NI = asked_NI & (wishes.costs_NI + wishes.calls_N[:, None] <= limit)
    single_NI = np.where(fits_NI, wishes.value_NI, -np.inf)
    bots_N = np.where(totals_N <= limit, wishes.worth_N(asked_NI), -np.inf)
    single, bot = single_NI.argmax(), bots_N.argmax()
    if max(single_NI.flat[single], bots_N[bot]) > worth:
        chosen_NI = np.zeros_like(chosen_NI)
        if bots_N[bot] >= single_NI.flat[single]:
            chosen_NI[bot] = asked_NI[bot]
        else:
            chosen_NI.flat[single] = True
    return chosen_NI


def _greedy_with_calls(wishes: Wishes, limit: float) -> _Bools:
    """Greedy with skips over all bots at once: the longest run of whole openings and later features, then the rest."""
    ranked = wishes.ranked()
    openings = _openings(ranked, wishes.calls_N)
    frame = _Frame(ranked.asked_NW, ranked.costs_NW, wishes.calls_N, limit)
    later_K = np.flatnonzero(ranked.asked_NW ^ openings.opening_NW)
    slopes = np.concatenate([openings.slopes_NW[:, 0], openings.slopes_NW.take(later_K)])
    costs = np.concatenate([openings.costs_N, ranked.costs_NW.take(later_K)])
    frame.run_openings(falling(slopes), costs, later_K, openings.opening_NW)
    places_K = frame.fitting()
    frame.fill(places_K[falling(openings.slopes_NW.take(places_K))])
    return ranked.unranked(frame.taken_NW, wishes.asked_NI)


class _Openings(NamedTuple):
    """By bot: which of its features open, and what they cost, the call included. The slopes of all its features."""

    opening_NW: _Bools
    costs_N: _Floats
    slopes_NW: _Floats


def _openings(ranked: Ranked, calls_N: _Floats) -> _Openings:
    """Of features in the order of density, those up to the most that they are worth per µs with the call."""
    costs_NW = np.cumsum(ranked.costs_NW, axis=1)
    costs_NW += calls_N[:, None]
    slopes_NW = np.cumsum(ranked.value_NW, axis=1)
    slopes_NW /= costs_NW
    np.fmin(slopes_NW, _LARGEST, out=slopes_NW)  # of hostile numbers infinity by infinity
    last_N1 = slopes_NW.argmax(axis=1)[:, None]
    best_N1 = np.take_along_axis(slopes_NW, last_N1, axis=1)
    opening_NW = np.arange(costs_NW.shape[1]) <= last_N1
    opening_NW &= ranked.asked_NW
    costs_N = np.take_along_axis(costs_NW, last_N1, axis=1)[:, 0] * opening_NW[:, 0]
    # No later feature before its opening: as real numbers none would be, but these are rounded.
    np.minimum(ranked.density_NW, np.maximum(best_N1, 0.0), out=slopes_NW)
    return _Openings(opening_NW, costs_N, slopes_NW)


class _Frame:
    """What has been taken of what N bots ask for in W columns, and what that has cost. Places are flat."""

    def __init__(self, asked_NW: _Bools, costs_NW: _Floats, calls_N: _Floats, limit: float) -> None:
        self.taken_NW = np.zeros_like(asked_NW)
        self._asked_NW, self._costs_NW, self._limit = asked_NW, costs_NW, limit
        self._unpaid_N = calls_N.copy()
        self._spent = 0.0

    def run(self, places_K: _Ints) -> None:
        """Take the longest run that fits, where no call is to be paid."""
        n, self._spent = _longest_run(self._costs_NW.take(places_K), self._spent, self._limit)
        self.taken_NW.reshape(-1)[places_K[:n]] = True

    def run_openings(self, order: _Ints, costs: _Floats, later_K: _Ints, opening_NW: _Bools) -> None:
        """Take the longest run that fits, of N openings and then K features in this order; part of the next opening.

        Each opening comes before its bot's later features.
        """
        n_bots = self._unpaid_N.size
        n, self._spent = _longest_run(costs.take(order), self._spent, self._limit)
        is_opening = order[:n] < n_bots
        opened = order[np.flatnonzero(is_opening)]
        self._unpaid_N[opened] = 0.0
        self.taken_NW[opened] = opening_NW[opened]
        self.taken_NW.reshape(-1)[later_K.take(order[np.flatnonzero(~is_opening)] - n_bots)] = True
        if n < order.size and order[n] < n_bots:
            bot = int(order[n])
            costs = self._costs_NW[bot, : np.count_nonzero(opening_NW[bot])].copy()
            costs[0] += self._unpaid_N[bot]
            n, self._spent = _longest_run(costs, self._spent, self._limit)
            self.taken_NW[bot, :n] = True
            self._unpaid_N[bot] *= n == 0

    def fitting(self) -> _Ints:
        """Places of all that has not been taken and might still fit."""
        left_NW = self._costs_NW <= (self._limit - self._spent - self._unpaid_N)[:, None]
        left_NW &= self._asked_NW
        left_NW &= ~self.taken_NW
        return np.flatnonzero(left_NW)

    def fill(self, places_K: _Ints) -> None:
        """Greedy with skips in this order, a run at a time, each bot's unpaid call on top of its first feature."""
        bots_K, costs_K = places_K // self.taken_NW.shape[1], self._costs_NW.take(places_K)
        for _ in range(MAX_PASSES):
            alone_K = costs_K + self._unpaid_N.take(bots_K)
            fits = np.flatnonzero(self._spent + alone_K <= self._limit)
            places_K, bots_K = places_K.take(fits), bots_K.take(fits)
            costs_K, alone_K = costs_K.take(fits), alone_K.take(fits)
            if places_K.size == 0:
                break
            first_N = np.full(self._unpaid_N.size, -1)
            first_N[bots_K[::-1]] = np.arange(bots_K.size)[::-1]  # what is written last stays
            first = first_N[first_N >= 0]
            prices_K = costs_K.copy()
            prices_K[first] = alone_K[first]
            n, self._spent = _longest_run(prices_K, self._spent, self._limit)
            self.taken_NW.reshape(-1)[places_K[:n]] = True
            self._unpaid_N[bots_K[:n]] = 0.0
            places_K, bots_K, costs_K = places_K[n:], bots_K[n:], costs_K[n:]


def _longest_run(costs_K: _Floats, spent: float, limit: float) -> tuple[int, float]:
    """How many fit one after the other, and what is then spent. Blocks are summed first: running sums take the time."""
    done = 0
    if costs_K.size > 2 * _BLOCK:
        blocks = spent + np.cumsum(np.add.reduceat(costs_K, np.arange(0, costs_K.size, _BLOCK)))
        n_blocks = int(np.searchsorted(blocks, limit, side="right"))
        if n_blocks:
            done, spent = n_blocks * _BLOCK, float(blocks[n_blocks - 1])
        costs_K = costs_K[done : done + _BLOCK]
    running_K = spent + np.cumsum(costs_K)
    n = int(np.searchsorted(running_K, limit, side="right"))
    return done + n, float(running_K[n - 1]) if n else spent
