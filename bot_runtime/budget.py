"""Allocation: what may be asked for within a budget, whatever the network says.

This module knows nothing about bots, bundles or the engine: arrays in, one boolean array out, no state.

The query is chosen by density, probability per µs, as in Dantzig's greedy for the knapsack problem, skipping what does
not fit; where one feature alone is worth more than all that greedy took, that one is asked for instead. With one call
cost a row that makes the result worth at least half of the best possible (Kellerer, Pferschy and Pisinger, *Knapsack
Problems*, 2004, section 2.1).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["MAX_PASSES", "allocate"]

# Costs are floats and the caller may add them in any order. Adding n numbers >= 0 is off by at most n/2 eps of the sum
# (Higham, Accuracy and Stability, 2002, eq. 4.4), here and again at the caller's; eight eps a term is ample for both.
_MARGIN_PER_TERM = 8.0 * np.finfo(np.float64).eps
_NOTHING_FITS = -1.0
_LEAST_DENSITY = -np.finfo(np.float64).max
# Each pass drops at least every feature of one cost, and a cost table has few distinct costs; a table of a thousand
# different ones may end early, which only leaves budget unspent.
MAX_PASSES = 64

_Bools = NDArray[np.bool_]
_Floats = NDArray[np.float64]


class _Items(NamedTuple):
    """R groups that share a budget each, I items a group. `owner` numbers the bot of each item, `calls` is by bot."""

    asked_RI: _Bools
    value_RI: _Floats
    costs_RI: _Floats
    owner_RI: NDArray[np.int64]
    calls: _Floats

    def arranged(self, arrange: Callable[[NDArray[Any]], NDArray[Any]]) -> _Items:
        arrays = (arrange(self.asked_RI), arrange(self.value_RI), arrange(self.costs_RI), arrange(self.owner_RI))
        return _Items(*arrays, self.calls)


def allocate(
    probs_NM: ArrayLike,
    sampled_NM: _Bools,
    costs_us: ArrayLike,
    call_us: ArrayLike,
    budgets_us_N: ArrayLike,
    frame_budget_us: float | None = None,
) -> _Bools:
    """The part of `sampled_NM` that may be asked for, shape [N, M].

    `costs_us` is [M] or [N, M], µs a feature; `call_us` a number or [N], paid once by each bot that asks for anything;
    `budgets_us_N` a number or [N], infinite where unlimited; `frame_budget_us` is shared by all N bots, on top of each
    bot's own.

    For any input whatever: each bot's cost is at most its budget and the sum over bots at most the frame's, as real
    numbers and however floats add them up (a few ulps of every budget are kept back for that). A NaN or infinite
    probability, a NaN, infinite or negative cost, and a NaN or negative budget ask for nothing. Deterministic; without
    a frame budget, no row depends on another. Where no budget binds, all that was sampled is asked for.
    """
    sampled_NM = np.asarray(sampled_NM, dtype=np.bool_)
    n_bots, n_queries = sampled_NM.shape
    probs_NM = np.asarray(probs_NM, dtype=np.float64)
    costs_NM = np.broadcast_to(np.asarray(costs_us, dtype=np.float64), sampled_NM.shape)
    calls_N = np.broadcast_to(np.asarray(call_us, dtype=np.float64), (n_bots,))
    budgets_N = np.broadcast_to(np.asarray(budgets_us_N, dtype=np.float64), (n_bots,))
    payable_NM = (costs_NM >= 0.0) & (costs_NM < np.inf) & ((calls_N >= 0.0) & (calls_N < np.inf))[:, None]
    asked_NM = sampled_NM & np.isfinite(probs_NM) & payable_NM
    owner_NM = np.repeat(np.arange(n_bots), n_queries).reshape(n_bots, n_queries)
    with np.errstate(all="ignore"):  # hostile numbers overflow; infinities compare as they should
        bots = _Items(asked_NM, probs_NM, np.where(asked_NM, costs_NM, 0.0), owner_NM, calls_N)
        query_NM = _fit(bots, _limits(budgets_N, n_queries + 1))
        if frame_budget_us is not None:
            frame = bots._replace(asked_RI=query_NM).arranged(lambda array_NM: array_NM.reshape(1, -1))
            limit = _limits(np.array([frame_budget_us], dtype=np.float64), n_bots * (n_queries + 1))
            query_NM = _fit(frame, limit).reshape(n_bots, n_queries)
    return query_NM


def _limits(budgets_R: _Floats, terms: int) -> _Floats:
    """What computed sums of `terms` terms must not exceed, so that their true sums stay within the budget."""
    legal_R = budgets_R >= 0.0  # false for NaN
    return np.where(legal_R, budgets_R * (1.0 - terms * _MARGIN_PER_TERM), _NOTHING_FITS)


def _fit(items: _Items, limits_R: _Floats) -> _Bools:
    """`asked` where all of it fits, else the greedy choice."""
    asked_RI = items.asked_RI
    totals_R = _marginal(items, asked_RI, None).sum(axis=1)
    tight = np.flatnonzero(~(totals_R <= limits_R) & asked_RI.any(axis=1))
    if tight.size == 0:
        return asked_RI
    fitted_RI = asked_RI.copy()
    fitted_RI[tight] = _best_of_two(items.arranged(lambda array_RI: array_RI[tight]), limits_R[tight])
    return fitted_RI


def _best_of_two(items: _Items, limits_R: _Floats) -> _Bools:
    chosen_RI = _greedy(items, limits_R)
    alone_RI = items.costs_RI + items.calls[items.owner_RI]
    fits_RI = items.asked_RI & (alone_RI <= limits_R[:, None])
    single_RI = np.where(fits_RI, items.value_RI, -np.inf)
    best_R = single_RI.argmax(axis=1)
    rows_R = np.arange(best_R.size)
    better = np.flatnonzero(single_RI[rows_R, best_R] > np.where(chosen_RI, items.value_RI, 0.0).sum(axis=1))
    chosen_RI[better] = False
    chosen_RI[better, best_R[better]] = True
    return chosen_RI


def _greedy(items: _Items, limits_R: _Floats) -> _Bools:
    """Sequential greedy with skips, a run of fitting items at a time.

    Each pass takes, in every group at once, the longest run of the densest candidates that fits, then drops what
    can no longer fit: the first item after the run at least.
    """
    density_RI = np.where(items.costs_RI > 0.0, items.value_RI / items.costs_RI, np.inf)
    density_RI = np.maximum(density_RI, _LEAST_DENSITY)  # minus infinity would sort with what was not asked for
    order_RI = np.argsort(np.where(items.asked_RI, -density_RI, np.inf), axis=1, kind="stable")
    order_RI = order_RI[:, : items.asked_RI.sum(axis=1).max()]  # what was not asked for sorts last
    order_RI += np.arange(len(order_RI))[:, None] * items.asked_RI.shape[1]  # as places of the flattened arrays
    ranked = items.arranged(lambda array_RI: array_RI.take(order_RI))
    costs, owner = ranked.costs_RI, ranked.owner_RI
    limits_R1 = limits_R[:, None]
    left_RI, taken_RI = ranked.asked_RI.copy(), np.zeros_like(ranked.asked_RI)
    spent_R1 = np.zeros_like(limits_R1)
    opened = np.zeros(items.calls.size, dtype=np.bool_)  # by bot: whether its call is paid
    for _ in range(MAX_PASSES):
        alone_RI = costs + np.where(opened, 0.0, items.calls)[owner]
        left_RI &= spent_R1 + alone_RI <= limits_R1
        if not left_RI.any():
            break
        running_RI = spent_R1 + np.cumsum(_marginal(ranked, left_RI, opened), axis=1)
        now_RI = left_RI & (running_RI <= limits_R1)
        spent_R1 = np.where(now_RI, running_RI, spent_R1).max(axis=1, keepdims=True)
        opened[owner[now_RI]] = True
        taken_RI |= now_RI
        left_RI &= ~now_RI
    chosen_RI = np.zeros_like(items.asked_RI)
    chosen_RI.put(order_RI, taken_RI)
    return chosen_RI


def _marginal(items: _Items, picked_RI: _Bools, opened: _Bools | None) -> _Floats:
    """Cost of each picked item once all before it in its row are taken: its own, and its bot's call if it is first."""
    marginal_RI = np.where(picked_RI, items.costs_RI, 0.0)
    if items.calls.any():
        picked = np.flatnonzero(picked_RI)
        owners = items.owner_RI.ravel()[picked]
        if opened is not None:
            picked, owners = picked[~opened[owners]], owners[~opened[owners]]
        payers, first = np.unique(owners, return_index=True)
        marginal_RI.flat[picked[first]] += items.calls[payers]  # ravel() would copy Fortran order
    return marginal_RI
