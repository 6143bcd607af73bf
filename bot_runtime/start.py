"""Start: what the start of some bots says, checked. A server's bots and a head's begin by the same rules.

This module knows nothing about handles or turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.context import Contexts
from bot_runtime.manifest import Manifest
from bot_runtime.request import Numbers
from bot_runtime.spending import Limits, Spending
from protocol.features import CostModel
from protocol.messages import MAX_RETURN, MAX_RETURN_TO_GO

__all__ = ["Start"]


class Start(NamedTuple):
    """Of N bots: seeds, target returns and turns that they took before, each [N]; limits; what features cost them."""

    seeds_N: NDArray[np.uint64]
    returns_N: NDArray[np.float64]
    turns_N: NDArray[np.int64] | None
    limits: Limits
    model: CostModel

    @classmethod
    def checked(
        cls,
        manifest: Manifest,
        seeds: Sequence[int] | NDArray[np.uint64],
        count: int,
        *,
        target_returns: Numbers,
        budgets_us: Numbers,
        target_costs_us: Numbers,
        cost_model: CostModel | None,
        turns: Sequence[int] | None = None,
    ) -> Self:
        """The bundle's target return and declared costs where none are said. Raises BadShape, NonFinite, OutOfRange."""
        model = cost_model or CostModel.declared(manifest.features)
        inputs.check_costs(model, manifest.features)
        returns_N = np.full(count, manifest.target_return)
        if target_returns is not None:
            most = MAX_RETURN if turns is None else MAX_RETURN_TO_GO  # a resumed bot's rewards have been counted
            returns_N = inputs.per_bot("target_returns", target_returns, count, -most, most)
        limits = Limits.checked(count, budgets_us, target_costs_us)
        turns_N = None if turns is None else inputs.turns(turns, count)
        return cls(inputs.seeds(seeds, count), returns_N, turns_N, limits, model)

    def begin(self, slots_N: NDArray[np.int64], contexts: Contexts, spending: Spending) -> None:
        """Give rows, all zero until now, to these bots."""
        contexts.begin(slots_N, self.seeds_N, self.returns_N, self.turns_N)
        spending.begin(slots_N, self.model, self.limits)
