"""What every bot may spend and is asked to spend: its costs, its budget and its target cost, in preallocated arrays.

This module knows nothing about handles, turns or policies. A budget is hard and `bot_runtime.budget` keeps it; a
target cost is what a budget-conditioned network is asked for, and nothing but its word keeps it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bot_runtime.costs import Costs
from bot_runtime.inputs import per_bot
from bot_runtime.manifest import Manifest
from protocol.features import CostModel

__all__ = ["MAX_BUDGET_US", "Limits", "Spending", "Terms"]

MAX_BUDGET_US = 1e9
_UNSAID = np.zeros(0)
_Floats = NDArray[np.float64]
_Numbers = Sequence[float] | NDArray[np.floating] | None


class Limits(NamedTuple):
    """What one request says of budgets and target costs in µs, each [N], the shared budget [1]; empty where unsaid."""

    budgets_N: _Floats
    targets_N: _Floats
    shared_1: _Floats

    @classmethod
    def checked(
        cls, n_bots: int, budgets_us: _Numbers, target_costs_us: _Numbers, frame_budget_us: float | None = None
    ) -> Limits:
        """Raises BadShape, NonFinite, OutOfRange (outside 0 to `MAX_BUDGET_US`)."""
        shared_us = None if frame_budget_us is None else (frame_budget_us,)
        return cls(
            _checked("budgets_us", budgets_us, n_bots),
            _checked("target_costs_us", target_costs_us, n_bots),
            _checked("frame_budget_us", shared_us, 1),
        )

    @property
    def frame_budget_us(self) -> float | None:
        """The budget that all bots of the request share, if it says one."""
        return float(self.shared_1[0]) if self.shared_1.size else None


class Terms(NamedTuple):
    """What counts for N bots in one frame: in µs costs [N, M], of calls, budgets, of everything; target costs [N].

    Budgets are infinite where there is none. Target costs are shares of each bot's full cost, within [0, 1].
    """

    costs_NM: _Floats
    calls_N: _Floats
    budgets_N: _Floats
    full_N: _Floats
    target_cost_N: NDArray[np.float32]


class Spending:
    """B rows, all zero where no bot lives. Methods take slots [N]: distinct row numbers, in the caller's order."""

    def __init__(self, manifest: Manifest, capacity: int) -> None:
        self._default_us = np.inf if manifest.is_unlimited else manifest.budget_us
        self._is_conditioned = manifest.is_conditioned
        self._default_share = manifest.target_cost or 0.0
        self._costs_BM = np.zeros((capacity, manifest.features.n_queries))
        self._calls_B = np.zeros(capacity)
        self._full_B = np.zeros(capacity)
        self._budgets_B = np.zeros(capacity)
        self._targets_B = np.zeros(capacity)

    def begin(self, slots_N: NDArray[np.int64], model: CostModel, said: Limits) -> None:
        """Give rows to new bots: their cost model, and their limits until a frame says others."""
        self._costs_BM[slots_N] = model.costs_us
        self._calls_B[slots_N] = model.call_us
        self._full_B[slots_N] = model.full_us
        self._budgets_B[slots_N] = said.budgets_N if said.budgets_N.size else self._default_us
        default_us = self._default_share * model.full_us
        self._targets_B[slots_N] = _first(said.targets_N, said.budgets_N, np.array([default_us]))

    def clear(self, slots_N: NDArray[np.int64]) -> None:
        """Zero these rows."""
        for array in (self._costs_BM, self._calls_B, self._full_B, self._budgets_B, self._targets_B):
            array[slots_N] = 0.0

    def terms(self, slots_N: NDArray[np.int64], said: Limits, measured: Costs | None = None) -> Terms:
        """What counts in a frame whose request says this. Where costs were measured, they replace the rows' own.

        The target cost is the first of: the frame's target cost, the frame's budget, the start's target cost, the
        start's budget, the bundle's default; and never more than the bot may spend, be it the budget in force or an
        equal part of the budget that the bots share. Where nothing costs anything it is 1. Where the network does not
        read it, it is 0, for those few µs count in every frame.
        """
        budgets_N = said.budgets_N if said.budgets_N.size else self._budgets_B[slots_N]
        if measured is None:
            costs_NM, calls_N, full_N = self._costs_BM[slots_N], self._calls_B[slots_N], self._full_B[slots_N]
        else:
            costs_NM = np.repeat(measured.costs_M[None], slots_N.size, axis=0)
            calls_N, full_N = np.full(slots_N.size, measured.call_us), np.full(slots_N.size, measured.full_us)
        share_N = self._shares(slots_N, said, budgets_N, full_N) if self._is_conditioned else np.zeros(slots_N.size)
        return Terms(costs_NM, calls_N, budgets_N, full_N, share_N.astype(np.float32))

    def _shares(self, slots_N: NDArray[np.int64], said: Limits, budgets_N: _Floats, full_N: _Floats) -> _Floats:
        target_us_N = np.minimum(_first(said.targets_N, said.budgets_N, self._targets_B[slots_N]), budgets_N)
        if said.shared_1.size:
            target_us_N = np.minimum(target_us_N, said.shared_1 / slots_N.size)
        return np.divide(np.minimum(target_us_N, full_N), full_N, out=np.ones_like(full_N), where=full_N > 0.0)


def _checked(name: str, numbers: _Numbers, size: int) -> _Floats:
    return _UNSAID if numbers is None else per_bot(name, numbers, size, 0.0, MAX_BUDGET_US)


def _first(*said: _Floats) -> _Floats:
    """The first that says anything."""
    return next(numbers for numbers in said if numbers.size)
