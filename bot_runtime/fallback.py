"""The ladder: what a bot does when its network's output cannot be used or does not come in time, and why.

This module knows nothing about networks, contexts or messages. Rungs, best first: the learned query and action; no
query, the action learned from free features; the last action again; the declared safe action.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

__all__ = ["Cause", "Counters", "Reason", "fallback_actions", "held_actions", "non_finite"]

_Reasons = NDArray[np.uint8]


class Cause(IntEnum):
    """What went wrong. Plus 0, 1 or 2 for the rung it makes the reason: no query, last action, safe action."""

    NON_FINITE = 1  # the network's output was not finite
    DEADLINE = 4  # inference took longer than the deadline left
    SHED = 7  # the deadline left less than inference takes, so there was none
    BREAKER = 10  # the bundle overran too often and waits for a probe, so there was no inference


class Reason(IntEnum):
    """Why a bot got its query or its action. The numbers travel in replies and never change their meaning.

    `..._QUERY`: nothing was asked for, and the action is learned from free features. `..._LAST_ACTION`: the last
    learned action again; `..._SAFE_ACTION`: the same on a bot without one, the declared safe action.
    """

    LEARNED = 0
    NON_FINITE_QUERY = 1
    NON_FINITE_STEP_LAST_ACTION = 2
    NON_FINITE_STEP_SAFE_ACTION = 3
    DEADLINE_QUERY = 4
    DEADLINE_LAST_ACTION = 5
    DEADLINE_SAFE_ACTION = 6
    SHED_QUERY = 7
    SHED_LAST_ACTION = 8
    SHED_SAFE_ACTION = 9
    BREAKER_QUERY = 10
    BREAKER_LAST_ACTION = 11
    BREAKER_SAFE_ACTION = 12


_LEARNED = int(Reason.LEARNED)


class Counters:
    """How often each rung was used, and how regular the engine's frames were. Numbers only grow."""

    def __init__(self) -> None:
        self._queries, self._actions = [0] * len(Reason), [0] * len(Reason)
        self.skipped_frames = 0  # frame numbers that a bot never saw, summed over bots
        self.abandoned_queries = 0  # pending queries that a newer frame replaced, summed over bots

    def count(self, reasons_N: _Reasons) -> None:
        """Add one action a bot."""
        _add(self._actions, reasons_N)

    def count_learned(self, n_bots: int) -> None:
        """Add one action a bot, all of them learned."""
        self._actions[_LEARNED] += n_bots

    def count_queries(self, n_bots: int, reasons_N: _Reasons | None) -> None:
        """Add one query a bot; no reasons: all learned."""
        if reasons_N is None:
            self._queries[_LEARNED] += n_bots
        else:
            _add(self._queries, reasons_N)

    @property
    def reasons(self) -> dict[Reason, int]:
        """Actions so far by reason, one a bot and turn."""
        return dict(zip(Reason, self._actions, strict=True))

    @property
    def query_reasons(self) -> dict[Reason, int]:
        """Queries so far by reason, one a bot and turn, be they ever answered or not."""
        return dict(zip(Reason, self._queries, strict=True))


def _add(counts: list[int], reasons_N: _Reasons) -> None:
    for reason, count in enumerate(np.bincount(reasons_N, minlength=len(counts)).tolist()):
        counts[reason] += count


def non_finite(asks_N: NDArray[np.bool_]) -> _Reasons | None:
    """The reasons [N] of queries where those are false whose means were not finite; None where all are true."""
    return None if asks_N.all() else np.where(asks_N, 0, Reason.NON_FINITE_QUERY).astype(np.uint8)


def held_actions(
    cause: Cause, last_NA: NDArray[np.float32], has_last_N: NDArray[np.bool_], safe_A: NDArray[np.float32]
) -> tuple[NDArray[np.float32], _Reasons]:
    """Each bot's action [N, A] where nothing was learned, and the reason [N]: the last one, or the safe one."""
    actions_NA = np.where(has_last_N[:, None], last_NA, safe_A)
    return actions_NA, np.where(has_last_N, cause + 1, cause + 2).astype(np.uint8)


def fallback_actions(
    learned_NA: NDArray[np.float32],
    usable_N: NDArray[np.bool_],
    query_reasons_N: _Reasons | None,
    held_NA: NDArray[np.float32],
    held_reasons_N: _Reasons,
) -> tuple[NDArray[np.float32], _Reasons]:
    """Each bot's action [N, A] from its best usable rung, and the reason [N].

    `usable_N` says whose turn computed only finite numbers; `query_reasons_N` why nothing was asked for, if so.
    """
    learned_N = np.zeros(len(usable_N), dtype=np.uint8) if query_reasons_N is None else query_reasons_N
    return np.where(usable_N[:, None], learned_NA, held_NA), np.where(usable_N, learned_N, held_reasons_N)
