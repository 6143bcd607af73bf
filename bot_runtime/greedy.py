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

from bot_runtime.wishes import Wishes, density, falling

__all__ = ["MAX_PASSES", "fit_frame", "fit_rows"]

# Each pass drops at least every feature of one cost, and a cost table has few distinct costs; a table of a thousand
# different ones may end early, which only leaves budget unspent.
MAX_PASSES = 64
_BLOCK = 512
_ROUNDING = 1e-9

_Bools = NDArray[np.bool_]
_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]


def fit_rows(wishes: Wishes, limits_N: _Floats) -> _Bools:
    """What each bot may ask for within its own limit: all, where that fits."""
    asked_NI = wishes.asked_NI
    if limits_N.min(initial=np.inf) == np.inf:
        return asked_NI
    (tight,) = (~(wishes.us_N(asked_NI) <= limits_N)).nonzero()  # a cost that is not a number does not fit either
    if tight.size == 0:
        return asked_NI
    if tight.size == limits_N.size:
        return _single_if_better(_greedy_rows(wishes, limits_N), wishes, limits_N)
    rows, limits_R = wishes.rows(tight), limits_N[tight]
    fitted_NI = asked_NI.copy()
    fitted_NI[tight] = _single_if_better(_greedy_rows(rows, limits_R), rows, limits_R)
    return fitted_NI


def fit_frame(wishes: Wishes, limit: float) -> _Bools:
    """What all bots together may ask for within one limit: all, where that fits."""
    asked_NI, totals_N = wishes.asked_NI, wishes.us_N(wishes.asked_NI)
    if totals_N.sum() <= limit or not asked_NI.any():
        return asked_NI
    if limit < 0.0:
        return np.zeros_like(asked_NI)
    frame = _Frame(wishes, limit)
    if wishes.calls_N.any():
        frame.greedy_with_calls(totals_N)
    else:
        frame.greedy()
    return _alone_if_better(frame.taken_NI, wishes, totals_N, limit)


def _greedy_rows(wishes: Wishes, limits_R: _Floats) -> _Bools:
    """Greedy with skips in every row at once, a run of fitting features at a time.

    Each pass takes the longest run of the densest candidates that fits, then drops what can no longer fit: the first
    feature after the run at least.
    """
    ranked = wishes.ranked()
    left_RW, costs_RW = ranked.asked_NW, ranked.costs_NW
    limits_R1, spent_R1 = limits_R[:, None], wishes.calls_N[:, None]
    taken_RW, rows_R = np.zeros(left_RW.shape, np.bool_), np.arange(limits_R.size)
    for _ in range(MAX_PASSES):
        left_RW &= spent_R1 + costs_RW <= limits_R1
        if not left_RW.any():
            break
        running_RW = costs_RW * left_RW
        np.add.accumulate(running_RW, 1, None, running_RW)
        running_RW += spent_R1
        fits_RW = running_RW <= limits_R1
        last_R = np.add.reduce(fits_RW, 1, np.int64) - 1
        spent_R1 = np.where(last_R < 0, spent_R1[:, 0], running_RW[rows_R, last_R])[:, None]
        fits_RW &= left_RW
        taken_RW |= fits_RW
        left_RW ^= fits_RW
    return ranked.unranked(taken_RW, wishes.asked_NI)


def _single_if_better(chosen_RI: _Bools, wishes: Wishes, limits_R: _Floats) -> _Bools:
    """The choice; or in rows where one feature that fits is worth more, that one."""
    worth_R = wishes.worth_N(chosen_RI)
    if (wishes.value_NI.max(axis=1, initial=0.0) <= worth_R).all():
        return chosen_RI
    fits_RI = wishes.asked_NI & (wishes.costs_NI + wishes.calls_N[:, None] <= limits_R[:, None])
    single_RI = np.where(fits_RI, wishes.value_NI, -np.inf)
    best_R = single_RI.argmax(axis=1)
    rows_R = np.arange(best_R.size)
    better = np.flatnonzero(single_RI[rows_R, best_R] > worth_R)
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


class _Openings(NamedTuple):
    """By bot: which of its features open, what they cost with the call, what they are worth per µs. Cost 0 if none."""

    opening_NI: _Bools
    costs_N: _Floats
    slopes_N: _Floats


def _openings(wishes: Wishes, density_NI: _Floats, totals_N: _Floats) -> _Openings:
    """The features that together are worth the most per µs, call included: Dinkelbach's iteration for the ratio.

    From the ratio of all that is asked for: those that are denser have a better one, until nothing changes.
    """
    asked_NI = wishes.asked_NI
    densest_N = (density_NI * asked_NI).max(axis=1)
    slopes_N = wishes.worth_N(asked_NI) / totals_N
    for _ in range(MAX_PASSES):
        slopes_N = np.fmin(slopes_N, densest_N)  # at least one feature, whatever rounding or hostile numbers do
        opening_NI = density_NI >= slopes_N[:, None]
        opening_NI &= asked_NI
        costs_N = wishes.us_N(opening_NI)
        better_N = wishes.worth_N(opening_NI) / costs_N
        if not (better_N > slopes_N * (1.0 + _ROUNDING)).any():
            break
        slopes_N = better_N
    return _Openings(opening_NI, costs_N, slopes_N)


class _Frame:
    """What has been taken of what N bots ask for, and what that has cost. Places are flat."""

    def __init__(self, wishes: Wishes, limit: float) -> None:
        self.taken_NI = np.zeros_like(wishes.asked_NI)
        self._wishes, self._limit = wishes, limit
        self._unpaid_N = wishes.calls_N.copy()
        self._spent = 0.0

    def greedy(self) -> None:
        """Where no call costs anything: the longest run in the order of density, then what still fits."""
        places_K = self._by_density(np.flatnonzero(self._wishes.asked_NI))
        n, self._spent = _longest_run(self._wishes.costs_NI.take(places_K), self._spent, self._limit)
        self.taken_NI.reshape(-1)[places_K[:n]] = True
        self._fill(self._by_density(self._fitting()))

    def greedy_with_calls(self, totals_N: _Floats) -> None:
        """The longest run of whole openings and later features in the order of slopes, then what still fits."""
        wishes, n_bots = self._wishes, self._unpaid_N.size
        density_NI = density(wishes.value_NI, wishes.costs_NI)
        openings = _openings(wishes, density_NI, totals_N)
        later_K = np.flatnonzero(wishes.asked_NI ^ openings.opening_NI)
        # Openings come first, also among equals: no later feature is taken before its bot's call is paid.
        order = falling(np.concatenate([openings.slopes_N, density_NI.take(later_K)]))
        costs = np.concatenate([openings.costs_N, wishes.costs_NI.take(later_K)])
        n, self._spent = _longest_run(costs.take(order), self._spent, self._limit)
        is_opening = order[:n] < n_bots
        opened = order[np.flatnonzero(is_opening)]
        self._unpaid_N[opened] = 0.0
        self.taken_NI[opened] = openings.opening_NI[opened]
        self.taken_NI.reshape(-1)[later_K.take(order[np.flatnonzero(~is_opening)] - n_bots)] = True
        if n < order.size and order[n] < n_bots:
            self._open_partly(int(order[n]), openings)
        places_K = self._by_density(self._fitting())
        bots_K = places_K // wishes.asked_NI.shape[1]
        slopes_K = np.minimum(openings.slopes_N.take(bots_K), density_NI.take(places_K))
        self._fill(places_K[falling(slopes_K)])

    def _open_partly(self, bot: int, openings: _Openings) -> None:
        """Take the longest run of an opening that does not fit as a whole."""
        features = self._by_density(np.flatnonzero(openings.opening_NI[bot]) + bot * self.taken_NI.shape[1])
        costs = self._wishes.costs_NI.take(features)
        costs[0] += self._unpaid_N[bot]
        n, self._spent = _longest_run(costs, self._spent, self._limit)
        self.taken_NI.reshape(-1)[features[:n]] = True
        if n:
            self._unpaid_N[bot] = 0.0

    def _by_density(self, places_K: _Ints) -> _Ints:
        value_K, costs_K = self._wishes.value_NI.take(places_K), self._wishes.costs_NI.take(places_K)
        return places_K[falling(density(value_K, costs_K))]

    def _fitting(self) -> _Ints:
        """Places of all that has not been taken and might still fit."""
        left_NI = self._wishes.costs_NI <= (self._limit - self._spent - self._unpaid_N)[:, None]
        left_NI &= self._wishes.asked_NI
        left_NI &= ~self.taken_NI
        return np.flatnonzero(left_NI)

    def _fill(self, places_K: _Ints) -> None:
        """Greedy with skips in this order, a run at a time, each bot's unpaid call on top of its first feature."""
        bots_K, costs_K = places_K // self.taken_NI.shape[1], self._wishes.costs_NI.take(places_K)
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
            self.taken_NI.reshape(-1)[places_K[:n]] = True
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
