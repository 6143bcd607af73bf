"""A step: a turn's second half. The network acts, and the contexts of those bots whose step is usable advance.

This module knows nothing about handles, messages or what was drawn: it is given a turn whose features have come.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from bot_runtime.context import Contexts
from bot_runtime.deadline import Deadline
from bot_runtime.draw import finite_rows
from bot_runtime.fallback import Cause, Counters, fallback_actions, held_actions, non_finite
from bot_runtime.haste import Haste
from bot_runtime.manifest import Manifest
from bot_runtime.policy import Policy
from bot_runtime.turns import Actions, Turn
from bot_runtime.work import Steps, Work

__all__ = ["Chance", "Step"]


class Chance(NamedTuple):
    """What a step may do: infer or not, and what it holds instead. `allowed_us` is what the deadline leaves."""

    deadline: Deadline | None
    held: Actions | None
    may_infer: bool
    allowed_us: float = 0.0
    graphs: tuple[str, ...] = ()


_ALL_TIME = Chance(None, None, may_infer=True)


class Step:
    """Steps the bots of one arena and counts the rungs of the fallback ladder. `clock` counts ns."""

    def __init__(
        self, manifest: Manifest, contexts: Contexts, counters: Counters, haste: Haste, clock: Callable[[], int]
    ) -> None:
        self._manifest, self._contexts, self._counters = manifest, contexts, counters
        self._haste, self._clock = haste, clock
        self._low_A, self._high_A = manifest.action.range

    def weigh(self, turn: Turn, batch: Batch, deadline: Deadline | None) -> Chance:
        """Whether there is time for the step of a turn; what is held is offered to whoever waits for the deadline.

        Raises NotReady where the deadline has passed and the request was refused. Changes nothing.
        """
        if deadline is None and not self._haste.breaker.is_open:
            return _ALL_TIME
        graphs = ("act",) if turn.is_prepared else ("query_probs", "act")
        cause = self._haste.cause_against(deadline, batch.n_bots, *graphs)
        held = self._held(turn, batch, cause or Cause.DEADLINE)
        if deadline is None:
            return Chance(None, held, may_infer=False)
        allowed_us = deadline.left_us()
        deadline.offer(held)
        return Chance(deadline, held, cause is None, allowed_us, graphs)

    def act(self, policy: Policy, turn: Turn, batch: Batch, chance: Chance) -> Steps[Actions]:
        """Act on what the batch holds of the turn, then advance the contexts of those bots whose step is finite.

        What does not come in time advances none.
        """
        if chance.may_infer:
            infer_us = 0.0 if turn.is_prepared else (yield from self._prepare(policy, turn, batch))
            batch.fetch_context()
            if self._manifest.samples_action:
                np.copyto(batch.noise_NA, turn.noise_NA)
            act_us = yield Work("act", policy.act, batch, self._clock)
            self._haste.observe("act", batch.n_bots, act_us)
            infer_us += act_us
            late = chance.deadline
            if late is None or self._haste.settle(late, batch.n_bots, chance.allowed_us, infer_us, *chance.graphs):
                return self._learned(turn, batch, infer_us)
        assert chance.held is not None  # all time there is does not run out
        self._counters.count(chance.held.reasons_N)
        return chance.held

    def _held(self, turn: Turn, batch: Batch, cause: Cause) -> Actions:
        """What is answered where nothing is learned."""
        contexts = self._contexts
        has_last_N = contexts.turns(batch) > 0
        action_NA, reasons_N = held_actions(cause, contexts.last_action(batch), has_last_N, self._manifest.action.safe)
        action_NA.setflags(write=False)
        reasons_N.setflags(write=False)
        return Actions(turn.frame, action_NA, reasons_N, 0.0, contexts.turns(batch).copy())

    def _prepare(self, policy: Policy, turn: Turn, batch: Batch) -> Steps[float]:
        """Run the acquisition graph of a turn whose query was not drawn, and how many µs that took."""
        batch.begin(turn.request[0], turn.left_N, turn.target_cost_N)
        prepare_us = yield Work("query_probs", policy.query_probs, batch, self._clock)
        self._haste.observe("query_probs", batch.n_bots, prepare_us)
        batch.keep_prepared()
        asks_N = finite_rows(batch.probs_NM) if turn.queries.reasons_N is None else None
        if asks_N is not None:  # a bot that acquired something had a query, whatever the network says
            asks_N |= turn.queries.query_NM.any(axis=1)
            turn.queries = turn.queries._replace(reasons_N=non_finite(asks_N))
        return prepare_us

    def _learned(self, turn: Turn, batch: Batch, infer_us: float) -> Actions:
        """Make what the network has just computed the bots' own."""
        # A Gaussian head may overshoot; what leaves is within the action that the bundle declares.
        action_NA = np.maximum(batch.action_NA, self._low_A)
        np.minimum(action_NA, self._high_A, out=action_NA)
        if batch.is_finite and turn.queries.reasons_N is None:
            reasons_N = np.zeros(batch.n_bots, dtype=np.uint8)  # all learned
            self._contexts.advance(batch, action_NA)
            self._counters.count_learned(batch.n_bots)
        else:
            action_NA, reasons_N = self._fall_back(turn, batch, action_NA)
            self._counters.count(reasons_N)
        action_NA.setflags(write=False)
        reasons_N.setflags(write=False)
        return Actions(turn.frame, action_NA, reasons_N, infer_us, self._contexts.turns(batch).copy())

    def _fall_back(
        self, turn: Turn, batch: Batch, learned_NA: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The actions and their reasons where not everything was finite; only contexts whose step was are advanced."""
        contexts, usable_N = self._contexts, batch.finite_N
        held = self._held(turn, batch, Cause.NON_FINITE)
        action_NA, reasons_N = fallback_actions(
            learned_NA, usable_N, turn.queries.reasons_N, held.action_NA, held.reasons_N
        )
        contexts.advance(batch, action_NA, usable_N)
        return action_NA, reasons_N
