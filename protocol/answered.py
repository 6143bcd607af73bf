"""Answered: the last turn of bots that were named together, and what a server said in it, for requests that repeat it.

This module knows nothing about connections or contexts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from protocol.history import Asked
from protocol.replies import Actions, Queries

__all__ = ["Answered", "Answers"]


class Answered(NamedTuple):
    """One turn, what was answered so far, and how often the client had resumed by then."""

    asked: Asked
    resumed: int
    queries: Queries | None = None
    actions: Actions | None = None

    def told(self, actions: Actions) -> Actions:
        """The answer to a whole turn, as to the features of its query: what was never asked for still says why."""
        if self.queries is None:
            return actions
        return actions._replace(reasons=np.where(actions.reasons == 0, self.queries.reasons, actions.reasons))


class Answers:
    """The last turn of each of the companies, bots in one order, that were heard of last."""

    def __init__(self, most: int) -> None:
        """`most` is the welcome's `max_bots`: a turn that was begun must be known until it ends."""
        self._turns: dict[tuple[int, ...], Answered] = {}
        self._most = 2 * most  # a bot may be in one that is under way, and in another that is over

    def last(self, bots: Sequence[int]) -> Answered | None:
        """The last turn of exactly these bots, in this order."""
        return self._turns.get(tuple(bots))

    def before(self, bots: Sequence[int], frame: int, resumed: int) -> Answered | None:
        """The same if it is this frame's, and from before the last time that they were resumed."""
        turn = self.last(bots)
        return turn if turn is not None and turn.asked.frame == frame and turn.resumed != resumed else None

    def keep(self, turn: Answered) -> None:
        """This is the last one of its bots; where there are too many, the oldest that is over is forgotten."""
        self._turns.pop(turn.asked.bots, None)
        if len(self._turns) >= self._most:
            over = (bots for bots, each in self._turns.items() if each.actions is not None)
            del self._turns[next(over, next(iter(self._turns)))]
        self._turns[turn.asked.bots] = turn

    def forget(self, bots: Sequence[int]) -> None:
        """Forget every turn that one of these was in."""
        self._turns = {named: turn for named, turn in self._turns.items() if set(named).isdisjoint(bots)}
