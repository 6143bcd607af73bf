"""What one message says before anything is acquired: free numbers, rewards and limits, checked.

This module knows nothing about turns, contexts or policies.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.company import Company, Means
from bot_runtime.costs import Costs
from bot_runtime.spending import Limits, Spending
from protocol.messages import MAX_RETURN

__all__ = ["NOTHING_SAID", "Numbers", "Request"]

NOTHING_SAID = Limits.checked(0, None, None)
Numbers = Sequence[float] | NDArray[np.floating] | None


class Request(Struct, frozen=True, eq=False):
    """Free numbers [N, F], rewards [N], what is said of limits, and what follows from it for these bots."""

    free_NF: NDArray[np.float32]
    rewards_N: NDArray[np.float64]
    limits: Limits
    means: Means

    @classmethod
    def checked(
        cls,
        checks: inputs.FeatureChecks,
        spending: Spending,
        company: Company,
        free_NF: NDArray[np.float32],
        rewards: Numbers,
        frame_budget_us: float | None,
        budgets_us: Numbers,
        target_costs_us: Numbers,
        costs: Costs | None,
    ) -> Request:
        """Raises BadShape, NonFinite, OutOfRange."""
        n_bots, rewards_N = company.n_bots, company.nothing_N
        checks.free(free_NF, company.handles_N)
        if rewards is not None:
            rewards_N = inputs.per_bot("rewards", rewards, n_bots, -MAX_RETURN, MAX_RETURN)
        limits, means = NOTHING_SAID, company.means
        if not (budgets_us is None and target_costs_us is None and frame_budget_us is None and costs is None):
            limits = Limits.checked(n_bots, budgets_us, target_costs_us, frame_budget_us)
            means = Means.of(spending.terms(company.slots_N, limits, costs))
        return cls(free_NF.copy(), rewards_N, limits, means)

    @property
    def budget_us(self) -> float:
        """Of all bots together, infinite where any has none."""
        shared_us = self.limits.frame_budget_us
        return self.means.budget_us if shared_us is None else min(self.means.budget_us, shared_us)

    @property
    def content(self) -> tuple[NDArray[Any], ...]:
        """What a retry must equal."""
        return self.free_NF, self.rewards_N, *self.limits
