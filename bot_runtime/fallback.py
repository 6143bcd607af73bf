"""The ladder: what a bot does when its network's output cannot be used, and why it did so.

This module knows nothing about networks, contexts or messages. Rungs, best first: the learned query and action; no
query, the action learned from free features; the last action again; the declared safe action.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Counters", "Reason", "fallback_actions"]


class Reason(IntEnum):
    """Why a bot got its action. The numbers travel in `Actions.reasons` and never change their meaning."""

    LEARNED = 0
    NON_FINITE_QUERY = 1  # query_probs were not finite: nothing was asked for, the action is learned from free features
    NON_FINITE_STEP_LAST_ACTION = 2  # the turn's output was not finite: the last action again
    NON_FINITE_STEP_SAFE_ACTION = 3  # the same on a bot without a last action: the declared safe action


class Counters:
    """How often each rung was used, and how regular the engine's frames were. Numbers only grow."""

    def __init__(self) -> None:
        self._reasons = np.zeros(len(Reason), dtype=np.int64)
        self.skipped_frames = 0  # frame numbers that a bot never saw, summed over bots
        self.abandoned_queries = 0  # pending queries that a newer frame replaced, summed over bots

    def count(self, reasons_N: NDArray[np.uint8]) -> None:
        """Add one turn a bot."""
        self._reasons += np.bincount(reasons_N, minlength=len(Reason))

    def count_learned(self, n_bots: int) -> None:
        """Add one turn a bot, all of them learned."""
        self._reasons[Reason.LEARNED] += n_bots

    @property
    def reasons(self) -> dict[Reason, int]:
        """Turns so far by reason, one a bot."""
        return {reason: int(self._reasons[reason]) for reason in Reason}


def fallback_actions(
    learned_NA: NDArray[np.float32],
    usable_N: NDArray[np.bool_],
    no_query_N: NDArray[np.bool_],
    last_NA: NDArray[np.float32],
    has_last_N: NDArray[np.bool_],
    safe_A: NDArray[np.float32],
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Each bot's action [N, A] from its best usable rung, and the reason [N].

    `usable_N` says whose turn computed only finite numbers, `no_query_N` whose query_probs were not finite.
    """
    actions_NA = np.where(has_last_N[:, None], last_NA, safe_A)
    actions_NA = np.where(usable_N[:, None], learned_NA, actions_NA)
    learned_N = np.where(no_query_N, Reason.NON_FINITE_QUERY, Reason.LEARNED)
    held_N = np.where(has_last_N, Reason.NON_FINITE_STEP_LAST_ACTION, Reason.NON_FINITE_STEP_SAFE_ACTION)
    return actions_NA, np.where(usable_N, learned_N, held_N).astype(np.uint8)
