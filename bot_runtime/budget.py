"""Allocation: what may be asked for within a budget, whatever the network says.

This module knows nothing about bots, bundles or the engine: arrays in, one boolean array out, no state.

A bot's own budget is kept first, the frame's then among what is left. Either way the query is chosen by value per µs,
where a feature's value is its probability; how good that choice is, `bot_runtime.greedy` proves.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bot_runtime.greedy import fit_frame, fit_rows
from bot_runtime.wishes import Wishes

__all__ = ["allocate"]

# Costs are floats and the caller may add them in any order. Adding n numbers >= 0 is off by at most n/2 eps of the sum
# (Higham, Accuracy and Stability, 2002, eq. 4.4), here and again at the caller's; eight eps a term is ample for both.
_MARGIN_PER_TERM = 8.0 * np.finfo(np.float64).eps
_NOTHING_FITS = -1.0

_Bools = NDArray[np.bool_]
_Floats = NDArray[np.float64]


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
    probs_NM = np.ascontiguousarray(probs_NM, dtype=np.float64)
    costs_us = np.asarray(costs_us, dtype=np.float64)
    calls_N = _spread(np.asarray(call_us, dtype=np.float64), (n_bots,))
    budgets_N = _spread(np.asarray(budgets_us_N, dtype=np.float64), (n_bots,))
    is_prob, is_cost, is_call = np.isfinite(probs_NM), _is_cost(costs_us), _is_cost(calls_N)
    asked_NM = sampled_NM & is_prob
    asked_NM &= is_cost
    asked_NM &= is_call[:, None]
    costs_NM = _spread(_cleaned(costs_us, is_cost), sampled_NM.shape)
    wishes = Wishes(asked_NM, _cleaned(probs_NM, is_prob), costs_NM, _cleaned(calls_N, is_call)).only(asked_NM)
    with np.errstate(all="ignore"):  # hostile numbers overflow; infinities compare as they should
        query_NM = fit_rows(wishes, _limits(budgets_N, n_queries + 1))
        if frame_budget_us is not None:
            limit = _limits(np.array([frame_budget_us], dtype=np.float64), n_bots * (n_queries + 1))
            query_NM = fit_frame(wishes if query_NM is asked_NM else wishes.only(query_NM), float(limit[0]))
    return query_NM


def _spread(numbers: _Floats, shape: tuple[int, ...]) -> _Floats:
    """As `broadcast_to`, which takes several µs even where nothing is to be done."""
    return numbers if numbers.shape == shape else np.broadcast_to(numbers, shape)


def _is_cost(us: _Floats) -> _Bools:
    return (us >= 0.0) & (us < np.inf)


def _cleaned(numbers: _Floats, legal: _Bools) -> _Floats:
    """Zero where nothing will be asked for: a NaN there would spoil sums."""
    return numbers if np.count_nonzero(legal) == legal.size else np.where(legal, numbers, 0.0)


def _limits(budgets_R: _Floats, terms: int) -> _Floats:
    """What computed sums of `terms` terms must not exceed, so that their true sums stay within the budget."""
    legal_R = budgets_R >= 0.0  # false for NaN
    return np.where(legal_R, budgets_R * (1.0 - terms * _MARGIN_PER_TERM), _NOTHING_FITS)
