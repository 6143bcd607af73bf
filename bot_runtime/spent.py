"""What budgets allowed, what bots asked for, and what engines measured: sums in µs over every frame so far.

This module knows nothing about bots, frames or how costs are learned. Numbers only grow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Spent"]


class Spent:
    """Sums over messages, each with all of its bots. A retry counts nothing.

    `allowed_us` is what the budgets in force would have let the bots ask for, never more than everything costs;
    `asked_us` the predicted cost of what they asked for. Of the `n_measured` frames of which an engine says how long
    acquiring took, `measured_us` is what it said and `predicted_us` what had been predicted for what was acquired;
    `error_us` is the sum of |measured - predicted|. `n_over_predicted` took longer than predicted, `n_over_budget`
    longer than the budgets of all of the message's bots, or the one that they share.
    """

    def __init__(self) -> None:
        self.allowed_us = self.asked_us = 0.0
        self.measured_us = self.predicted_us = self.error_us = 0.0
        self.n_measured = self.n_over_predicted = self.n_over_budget = 0

    def ask(self, cost_us_N: NDArray[np.float64], allowed_us: float) -> None:
        """One message's queries, and what its bots were allowed."""
        self.asked_us += sum(cost_us_N.tolist())
        self.allowed_us += allowed_us

    def measure(self, measured_us: float, predicted_us: float, budget_us: float) -> None:
        """One message's measurement."""
        self.n_measured += 1
        self.measured_us += measured_us
        self.predicted_us += predicted_us
        self.error_us += abs(measured_us - predicted_us)
        self.n_over_predicted += measured_us > predicted_us
        self.n_over_budget += measured_us > budget_us
