"""A step: a turn's second half. The network acts, and the contexts of those bots whose step is usable advance.

This module knows nothing about handles, messages or what was drawn: it is given a turn whose features have come.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from bot_runtime.context import Contexts
from bot_runtime.draw import timed_us
from bot_runtime.fallback import Counters, fallback_actions
from bot_runtime.manifest import Manifest
from bot_runtime.policy import Policy
from bot_runtime.turns import Actions, Turn

__all__ = ["Step"]


class Step:
    """Steps the bots of one arena and counts the rungs of the fallback ladder. `clock` counts ns."""

    def __init__(self, manifest: Manifest, contexts: Contexts, counters: Counters, clock: Callable[[], int]) -> None:
        self._manifest, self._contexts, self._counters, self._clock = manifest, contexts, counters, clock
        self._low_A, self._high_A = manifest.action.range

    def act(self, policy: Policy, turn: Turn, batch: Batch) -> Actions:
        """Act on what the batch holds of the turn, then advance the contexts of those bots whose step is finite."""
        batch.fetch_context()
        if self._manifest.samples_action:
            np.copyto(batch.noise_NA, turn.noise_NA)
        infer_us = timed_us(self._clock, policy.act, batch)
        # A Gaussian head may overshoot; what leaves is within the action that the bundle declares.
        action_NA = np.maximum(batch.action_NA, self._low_A)
        np.minimum(action_NA, self._high_A, out=action_NA)
        if batch.is_finite and turn.asks_N is None:
            reasons_N = np.zeros(batch.n_bots, dtype=np.uint8)  # all learned
            self._contexts.advance(batch, action_NA)
            self._counters.count_learned(batch.n_bots)
        else:
            action_NA, reasons_N = self._fall_back(turn, batch, action_NA)
            self._counters.count(reasons_N)
        action_NA.flags.writeable = reasons_N.flags.writeable = False
        return Actions(turn.frame, action_NA, reasons_N, infer_us, self._contexts.turns(batch).copy())

    def _fall_back(
        self, turn: Turn, batch: Batch, learned_NA: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The actions and their reasons where not everything was finite; only contexts whose step was are advanced."""
        contexts, usable_N = self._contexts, batch.finite_N
        action_NA, reasons_N = fallback_actions(
            learned_NA,
            usable_N,
            np.zeros(batch.n_bots, dtype=np.bool_) if turn.asks_N is None else ~turn.asks_N,
            contexts.last_action(batch),
            contexts.turns(batch) > 0,
            self._manifest.action.safe,
        )
        contexts.advance(batch, action_NA, usable_N)
        return action_NA, reasons_N
