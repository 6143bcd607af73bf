"""Roster: which bots there are, and all that is kept of each, from their start to their stop.

This module knows nothing about networks, or about what bots do in a turn.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bot_runtime.company import Companies
from bot_runtime.context import Contexts
from bot_runtime.fallback import Counters
from bot_runtime.manifest import Manifest
from bot_runtime.request import NOTHING_SAID, Numbers
from bot_runtime.slots import Slots
from bot_runtime.spending import Spending
from bot_runtime.start import Start
from bot_runtime.turns import Turns
from protocol.errors import BadSchema
from protocol.features import CostModel

__all__ = ["Roster"]

_Handles = NDArray[np.int64]


class Roster:
    """Up to `max_bots` bots by their handles. Every refused call (any ProtocolError) leaves each as it was."""

    def __init__(self, manifest: Manifest, max_bots: int, counters: Counters, first_generation: int | None) -> None:
        """`first_generation` of the handles is random where it is None: none outlives a process."""
        self._manifest = manifest
        generation = secrets.randbits(31) if first_generation is None else first_generation
        self._slots = Slots(max_bots, first_generation=generation)
        self._contexts = Contexts(manifest, max_bots)
        self._spending = Spending(manifest, max_bots)
        self._companies = Companies(self._slots, self._contexts, self._spending)
        self._turns = Turns(max_bots, counters)
        self._started = 0

    @property
    def n_bots(self) -> int:
        """How many bots there are."""
        return self._slots.n_live

    @property
    def max_bots(self) -> int:
        """How many bots fit."""
        return self._slots.capacity

    def start(
        self,
        count: int,
        *,
        seeds: Sequence[int] | NDArray[np.uint64] | None = None,
        target_returns: Numbers = None,
        budgets_us: Numbers = None,
        target_costs_us: Numbers = None,
        cost_model: CostModel | None = None,
        turns: Sequence[int] | None = None,
    ) -> _Handles:
        """Start bots and return their handles, int64 [count].

        Defaults: the n-th bot started here has seed n; the bundle's target return and budget (none at all when it
        was trained without a limit); the costs that the feature table declares; a target cost as large as the budget,
        where one is given, else the bundle's; no `turns`, which are those that bots of before took at a server that is
        gone, to be replayed. Raises BadSchema, BadShape, NonFinite, OutOfRange, TooManyBots.
        """
        if count < 1:
            raise BadSchema(f"count is {count}, expected at least 1")
        said = Start.checked(
            self._manifest, range(self._started, self._started + count) if seeds is None else seeds, count,
            target_returns=target_returns, budgets_us=budgets_us, target_costs_us=target_costs_us,
            cost_model=cost_model, turns=turns,
        )  # fmt: skip
        slots_N = self._slots.take(count)
        self._started += count
        said.begin(slots_N, self._contexts, self._spending)
        return self._slots.handles(slots_N)

    def hidden(self, handles: _Handles) -> NDArray[np.float32]:
        """Each bot's hidden state after its last turn, a copy, [N, W]. Raises BadShape, BadSchema, NoBot."""
        return self._contexts.hidden(self._companies.named(handles, NOTHING_SAID).batch)

    def stop(self, handles: _Handles) -> int:
        """End these bots and zero all that is kept of them; how many. Raises BadShape, BadSchema, NoBot.

        A query pending for them and for others can no longer be answered; the others go on with their next frame.
        """
        slots_N = self._slots.resolve(handles)
        self._companies.forget(slots_N)
        self._turns.leave(slots_N)
        self._contexts.clear(slots_N)
        self._spending.clear(slots_N)
        self._slots.release(slots_N)
        return int(slots_N.size)
