"""Companies: the bots that are named together, again and again, and what is worked out for them only once.

This module knows nothing about messages or turns' contents. An engine names the same bots in the same order frame after
frame; all that depends on nothing else is kept with them: their slots, their batch, what they may spend.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from bot_runtime.budget import allocate
from bot_runtime.context import Contexts
from bot_runtime.slots import Slots
from bot_runtime.spending import Limits, Spending, Terms
from protocol.errors import OverBudget

if TYPE_CHECKING:  # a turn is a company's, and a company remembers its last turn
    from bot_runtime.turns import Turn

__all__ = ["ORDERS", "Companies", "Company", "Means"]

ORDERS = 4
"""Of all bots that there may be, so many times over in companies, of which there are as many as bots: one takes 40 kB
and each bot of it another two. An engine that names its bots in ever new orders pushes out the oldest."""
# What stays this far below a budget needs no allocation, for allocation keeps back less than that of it.
_AMPLE = 1.0 - 1e-6
_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Means:
    """What counts for N bots in one frame, and what they may spend without a second look."""

    terms: Terms
    ample_N: _Floats
    calls_cost: bool  # whether any call does
    budget_us: float  # of all bots together; infinite where any has none
    allowed_us: float  # the same, never more than everything costs

    @classmethod
    def of(cls, terms: Terms) -> Means:
        """What follows from a frame's terms."""
        budgets_N = terms.budgets_N
        return cls(
            terms,
            budgets_N * _AMPLE,
            bool(terms.calls_N.any()),
            sum(budgets_N.tolist()),
            sum(np.minimum(budgets_N, terms.full_N).tolist()),
        )

    def fit(
        self, probs_NM: NDArray[np.float32], sampled_NM: NDArray[np.bool_], frame_budget_us: float | None
    ) -> tuple[NDArray[np.bool_], _Floats]:
        """What `allocate` leaves of the sampled queries, [N, M], and its predicted µs, [N]. Changes `sampled_NM`.

        Most frames need no allocation; without a shared budget no other bots than those that sampled too much do.
        """
        costs_NM, calls_N, budgets_N = self.terms[:3]
        query_NM, cost_us_N = sampled_NM, self.cost_us(sampled_NM)
        fits_N = cost_us_N <= self.ample_N
        if frame_budget_us is None:
            if np.count_nonzero(fits_N) == fits_N.size:
                return query_NM, cost_us_N
            rows = np.flatnonzero(~fits_N)
            rest = (costs_NM[rows], calls_N[rows], budgets_N[rows])
            query_NM[rows] = allocate(probs_NM[rows], sampled_NM[rows], *rest)
        elif not (fits_N.all() and cost_us_N.sum() <= frame_budget_us * _AMPLE):
            query_NM = allocate(probs_NM, sampled_NM, costs_NM, calls_N, budgets_N, frame_budget_us)
        return query_NM, self.cost_us(query_NM)

    def check(self, cost_us_N: _Floats, frame_budget_us: float | None) -> None:
        """Raises OverBudget unless queries of these costs, [N], fit."""
        budgets_N = self.terms.budgets_N
        if not (cost_us_N <= budgets_N).all():
            row = int(np.argmax(cost_us_N > budgets_N))
            said = f"the query of bot {row} of the message costs {float(cost_us_N[row])!r} us"
            raise OverBudget(f"{said}, expected at most its budget of {float(budgets_N[row])!r} us")
        if frame_budget_us is not None and cost_us_N.sum() > frame_budget_us:
            said = f"the message's queries cost {float(cost_us_N.sum())!r} us"
            raise OverBudget(f"{said}, expected at most the frame's budget of {float(frame_budget_us)!r} us")

    def cost_us(self, query_NM: NDArray[np.bool_]) -> _Floats:
        """What a query costs, predicted µs, [N]."""
        cost_us_N: _Floats = np.vecdot(self.terms.costs_NM, query_NM)
        if self.calls_cost:
            cost_us_N += np.where(query_NM.any(axis=1), self.terms.calls_N, 0.0)
        return cost_us_N


@dataclass(eq=False)
class Company:
    """N bots in one order. `turn` is the last one that they began together, be it over or left by some of them."""

    handles_N: NDArray[np.int64]
    batch: Batch
    means: Means  # where a frame says nothing of budgets
    turn: Turn | None = None

    def __post_init__(self) -> None:
        self.slots_N = self.batch.slots_N  # their rows of the arena
        self.n_bots = self.batch.n_bots
        self.nothing_N = np.zeros(self.n_bots)  # what they have earned where nothing is said of that
        self.nothing_N.setflags(write=False)


class Companies:
    """The companies that were named last, by their handles."""

    def __init__(self, slots: Slots, contexts: Contexts, spending: Spending) -> None:
        self._slots, self._contexts, self._spending = slots, contexts, spending
        self._known: dict[bytes, Company] = {}
        self._n_bots = 0  # of all of these

    def named(self, handles_N: NDArray[np.int64], unsaid: Limits) -> Company:
        """The company of these bots; `unsaid` are limits that say nothing. Raises what `Slots.resolve` raises."""
        key = handles_N.tobytes()
        company = self._known.get(key)
        if company is not None and handles_N.dtype == np.int64 and handles_N.ndim == 1:
            return company
        slots_N = self._slots.resolve(handles_N)
        means = Means.of(self._spending.terms(slots_N, unsaid))
        company = Company(handles_N.copy(), self._contexts.batch(slots_N), means)
        self._n_bots += company.n_bots
        while self._n_bots > ORDERS * self._slots.capacity or len(self._known) == self._slots.capacity:
            self._n_bots -= self._known.pop(next(iter(self._known))).n_bots
        self._known[key] = company
        return company

    def forget(self, slots_N: NDArray[np.int64]) -> None:
        """Forget every company that one of these was in."""
        gone = set(slots_N.tolist())
        self._known = {key: each for key, each in self._known.items() if gone.isdisjoint(each.slots_N.tolist())}
        self._n_bots = sum(each.n_bots for each in self._known.values())
