"""History: what a client keeps of its bots, so that another server can be told where they were.

This module knows nothing about sockets or servers. Of each bot it keeps what its start said, what it has left of its
target return, and its last turns, in the messages that they came in: PROTOCOL.md, *Resume*, says why so many.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Asked", "Bot", "History", "Taken"]

_SLACK = 64  # turns in the log beyond those that were needed when it was last gone through


@dataclass
class Bot:
    """One bot: its start, what it has left, how many turns its context took, the frame whose rewards were counted."""

    seed: int
    left: float
    budget_us: float | None
    target_cost_us: float | None
    turns: int = 0
    frame: int = -1


class Asked(NamedTuple):
    """A turn's first half: its bots, free numbers [N, F], limits as they were said, and what each bot then had left."""

    bots: tuple[int, ...]
    frame: int
    free_NF: NDArray[np.float32]
    limits: dict[str, Any]
    left_N: NDArray[np.float64]


class Taken(NamedTuple):
    """A turn that the contexts of `rows` took, and what was acquired in it, as arguments of `BotClient.take`."""

    asked: Asked
    acquired: dict[str, Any]
    rows: NDArray[np.bool_]

    @property
    def bots(self) -> list[int]:
        """Whose contexts took it."""
        return [bot for bot, took in zip(self.asked.bots, self.rows, strict=True) if took]

    def again(self) -> dict[str, Any]:
        """The message of those bots, as arguments of `BotClient.take` but for the handles."""
        per_bot = {name: _rows(value, self.rows) for name, value in {**self.acquired, **self.asked.limits}.items()}
        left_N, free_NF = self.asked.left_N[self.rows], self.asked.free_NF[self.rows]
        return {"frame": self.asked.frame, "free": free_NF, **per_bot, "replayed_returns_to_go": left_N}


class History:
    """Bots by number, and the log of the turns that rebuild them: `depth` turns a bot, and some more."""

    def __init__(self, depth: int) -> None:
        """`depth` is the welcome's `replay_frames`."""
        self.bots: dict[int, Bot] = {}
        self._depth = depth
        self._log: list[Taken] = []
        self._prune_at = depth + _SLACK

    def begin(
        self,
        numbers: Sequence[int],
        seeds: Sequence[int],
        default_return: float,
        *,
        target_returns: Sequence[float] | None,
        budgets_us: Sequence[float] | None,
        target_costs_us: Sequence[float] | None,
    ) -> None:
        """These bots have been started."""
        limits = (target_returns, budgets_us, target_costs_us)
        for row, number in enumerate(numbers):
            left, budget_us, target_us = (None if said is None else float(said[row]) for said in limits)
            self.bots[number] = Bot(seeds[row], default_return if left is None else left, budget_us, target_us)

    def ask(
        self, bots: Sequence[int], frame: int, free: ArrayLike, rewards: ArrayLike | None, limits: dict[str, Any]
    ) -> Asked:
        """A first half as it is about to be sent: nothing is counted yet."""
        left_N = np.array([self.bots[bot].left for bot in bots])
        if rewards is not None and any(self.bots[bot].frame != frame for bot in bots):
            left_N = left_N - np.asarray(rewards, dtype=np.float64)
        kept = {name: _kept(value) for name, value in limits.items() if value is not None}
        return Asked(tuple(bots), frame, np.array(free, dtype=np.float32), kept, left_N)

    def count(self, asked: Asked) -> None:
        """The server has counted these rewards."""
        for bot, left in zip(asked.bots, asked.left_N.tolist(), strict=True):
            self.bots[bot].left, self.bots[bot].frame = left, asked.frame

    def take(self, asked: Asked, acquired: dict[str, Any], turns_N: NDArray[np.int64]) -> None:
        """The turn was answered, and the bots' contexts have taken so many turns with it."""
        before_N = np.array([self.bots[bot].turns for bot in asked.bots])
        if not (turns_N > before_N).any():
            return  # a retry, or a turn that no context took
        kept = {name: _kept(value) for name, value in acquired.items() if value is not None}
        self._log.append(Taken(asked, kept, turns_N > before_N))
        for bot, turns in zip(asked.bots, turns_N.tolist(), strict=True):
            self.bots[bot].turns = turns
        if len(self._log) > self._prune_at:
            self._log = self.needed()
            self._prune_at = 2 * len(self._log) + _SLACK

    def needed(self) -> list[Taken]:
        """The turns that rebuild every bot, the oldest first."""
        later, needed = Counter[int](), []
        for taken in reversed(self._log):
            if any(later[bot] < self._depth for bot in taken.bots):
                needed.append(taken)
                later.update(taken.bots)
        return needed[::-1]

    def forget(self, bots: Sequence[int]) -> None:
        """These have ended."""
        for bot in bots:
            del self.bots[bot]
        alive = [each._replace(rows=each.rows & [bot in self.bots for bot in each.asked.bots]) for each in self._log]
        self._log = [taken for taken in alive if taken.rows.any()]

    def groups(self) -> Iterator[tuple[list[int], dict[str, Any]]]:
        """Bots that can be started by one message, and its arguments but for `turns`; each bot once, in order."""
        kinds: dict[tuple[bool, bool], list[int]] = {}
        for number, bot in self.bots.items():
            kinds.setdefault((bot.budget_us is None, bot.target_cost_us is None), []).append(number)
        for (no_budget, no_target), numbers in kinds.items():
            bots = [self.bots[number] for number in numbers]
            yield (
                numbers,
                {
                    "seeds": [bot.seed for bot in bots],
                    "target_returns": [bot.left for bot in bots],
                    "budgets_us": None if no_budget else [bot.budget_us for bot in bots],
                    "target_costs_us": None if no_target else [bot.target_cost_us for bot in bots],
                },
            )


def _kept(value: Any) -> Any:
    """The caller may write into its arrays again."""
    return float(value) if np.ndim(value) == 0 else np.array(value)


def _rows(value: Any, rows: NDArray[np.bool_]) -> Any:
    return value[rows] if isinstance(value, np.ndarray) else value
