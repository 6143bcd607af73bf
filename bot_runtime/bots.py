"""Bots: the only stateful façade. Start bots, ask what each should acquire, submit it and get actions, stop bots.

This module knows nothing about bytes, sockets, connections or time (but for the injected clock that measures
inference). It is not thread-safe: one worker owns it.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.bundle import Bundle
from bot_runtime.company import Companies, Company, Means
from bot_runtime.context import Contexts
from bot_runtime.costs import MAX_ACQUIRE_US, Costs
from bot_runtime.draw import draw
from bot_runtime.fallback import Counters
from bot_runtime.policy import Policy
from bot_runtime.slots import Slots
from bot_runtime.spending import Limits, Spending
from bot_runtime.spent import Spent
from bot_runtime.step import Step
from bot_runtime.turns import Actions, Queries, Turn, Turns
from protocol.errors import BadSchema, FrameReused
from protocol.features import CostModel
from protocol.messages import MAX_RETURN
from protocol.values import check_frame

__all__ = ["Bots"]

_Handles = NDArray[np.int64]
_Numbers = Sequence[float] | NDArray[np.floating] | None
_NOTHING_SAID = Limits.checked(0, None, None)


class Bots:
    """All bots of one bundle in one process. A batch of N bots is the native shape; one bot is N = 1.

    Every refused call (any ProtocolError) leaves every bot exactly as it was. A repeated request with the same content
    gets the same reply object again and advances nothing; replies are read-only arrays. `counters` says how often
    each rung of the fallback ladder was used, `spent` what was asked for and what it really cost.
    """

    def __init__(
        self,
        bundle: Bundle,
        *,
        max_bots: int = 256,
        clock: Callable[[], int] = time.perf_counter_ns,
        first_generation: int | None = None,
    ) -> None:
        """`clock` counts ns. `first_generation` of the handles are random by default: none outlives a process."""
        self.bundle = bundle
        self.counters = Counters()
        self.spent = Spent()
        self._clock = clock
        self._policy = Policy(bundle)
        generation = secrets.randbits(31) if first_generation is None else first_generation
        self._slots = Slots(max_bots, first_generation=generation)
        self._contexts = Contexts(bundle.manifest, max_bots)
        self._turns = Turns(max_bots, self.counters)
        self._step = Step(bundle.manifest, self._contexts, self.counters, clock)
        self._spending = Spending(bundle.manifest, max_bots)
        self._companies = Companies(self._slots, self._contexts, self._spending)
        self._checks = inputs.FeatureChecks(bundle.manifest.features, max_bots)
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
        target_returns: _Numbers = None,
        budgets_us: _Numbers = None,
        target_costs_us: _Numbers = None,
        cost_model: CostModel | None = None,
    ) -> _Handles:
        """Start bots and return their handles, int64 [count].

        Defaults: the n-th bot started here has seed n; the bundle's target return and budget (none at all when it
        was trained without a limit); the costs that the feature table declares; a target cost as large as the budget,
        where one is given, else the bundle's. Raises BadSchema, BadShape, NonFinite, OutOfRange, TooManyBots.
        """
        if count < 1:
            raise BadSchema(f"count is {count}, expected at least 1")
        manifest = self.bundle.manifest
        model = cost_model or CostModel.declared(manifest.features)
        inputs.check_costs(model, manifest.features)
        returns_N = np.full(count, manifest.target_return)
        if target_returns is not None:
            returns_N = inputs.per_bot("target_returns", target_returns, count, -MAX_RETURN, MAX_RETURN)
        limits = Limits.checked(count, budgets_us, target_costs_us)
        numbered = range(self._started, self._started + count)
        seeds_N = inputs.seeds(numbered if seeds is None else seeds, count)
        slots_N = self._slots.take(count)
        self._started += count
        self._contexts.begin(slots_N, seeds_N, returns_N)
        self._spending.begin(slots_N, model, limits)
        return self._slots.handles(slots_N)

    def request_queries(
        self,
        handles: _Handles,
        frame: int,
        free_NF: NDArray[np.float32],
        rewards_N: _Numbers = None,
        frame_budget_us: float | None = None,
        budgets_us: _Numbers = None,
        target_costs_us: _Numbers = None,
        costs: Costs | None = None,
    ) -> Queries:
        """What each bot asks for in this frame, within its own budget and, together, within `frame_budget_us`.

        `rewards_N` came since each bot's last frame and leave its return-to-go, once. `budgets_us` and
        `target_costs_us`, one number a bot, replace those of the bots' start for this frame only; how they make the
        network's target cost is `Spending.terms`. `costs`, as the bots' engine measures them, replace those of their
        start for this frame. A newer frame abandons a pending query. Raises BadShape, BadSchema,
        NoBot, StaleFrame, FrameReused, NonFinite, OutOfRange.
        """
        company = self._companies.named(handles, _NOTHING_SAID)
        check_frame(frame)
        retried = self._turns.query(company, frame)
        self._checks.free(free_NF, handles)
        if rewards_N is None:
            rewards_N = np.zeros(company.n_bots)
        else:
            rewards_N = inputs.per_bot("rewards", rewards_N, company.n_bots, -MAX_RETURN, MAX_RETURN)
        limits, means = _NOTHING_SAID, company.means
        if any(said is not None for said in (budgets_us, target_costs_us, frame_budget_us, costs)):
            limits = Limits.checked(company.n_bots, budgets_us, target_costs_us, frame_budget_us)
            means = Means.of(self._spending.terms(company.slots_N, limits, costs))
        request = (free_NF.copy(), rewards_N, *limits)
        if retried is not None:
            _check_same(request, retried.request, frame)
            return retried.queries
        returns_to_go_N = self._contexts.returns_to_go(company.batch) - rewards_N
        turn = self._ask(company, frame, request, returns_to_go_N, means, limits.frame_budget_us)
        self._contexts.spend(company.batch, returns_to_go_N)
        company.batch.keep_prepared()
        self._turns.begin(company, turn)
        self.spent.ask(turn.queries.cost_us_N, min(means.allowed_us, turn.budget_us))
        return turn.queries

    def submit_features(
        self,
        handles: _Handles,
        frame: int,
        acquired_NM: NDArray[np.bool_],
        costly_ND: NDArray[np.float32],
        failed_NM: NDArray[np.bool_] | None = None,
        acquire_us: float | None = None,
        costs: Costs | None = None,
    ) -> Actions:
        """Answer the pending query of exactly these bots, in its order, and get their actions.

        `costly_ND` is dense; numbers of features that were not acquired, or are marked failed, are never looked at.
        `acquire_us` is what acquiring took for all of these bots; `costs` learn from it, once a turn.
        Raises BadShape, BadSchema, NoBot, StaleFrame, NoPendingQuery, UnrequestedFeature, MissingFeature, NonFinite,
        OutOfRange, FrameReused.
        """
        company = self._companies.named(handles, _NOTHING_SAID)
        check_frame(frame)
        turn, batch = self._turns.features(company, frame), company.batch
        staged_ND = batch.costly_ND if turn.actions is None else np.empty_like(batch.costly_ND)
        query_NM = turn.queries.query_NM
        known_NM = self._checks.costly(acquired_NM, costly_ND, failed_NM, query_NM, handles, staged_ND)
        measured = () if acquire_us is None else (acquire_us,)
        measured_us = inputs.per_bot("acquire_us", measured, len(measured), 0.0, MAX_ACQUIRE_US)
        if turn.actions is not None:
            kept = (*self._contexts.acquired(batch), turn.measured_us)
            _check_same((staged_ND, known_NM, measured_us), kept, frame)
            return turn.actions
        np.copyto(batch.query_NM, known_NM)
        turn.actions, turn.measured_us = self._step.act(self._policy, turn, batch), measured_us
        batch.keep_acquired()
        if acquire_us is not None and costs is not None:
            predicted_us = costs.observe(acquired_NM, acquire_us)
            if predicted_us is not None:
                self.spent.measure(acquire_us, predicted_us, turn.budget_us)
        return turn.actions

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

    def _ask(
        self,
        company: Company,
        frame: int,
        request: tuple[NDArray[Any], ...],
        returns_to_go_N: NDArray[np.float64],
        means: Means,
        frame_budget_us: float | None,
    ) -> Turn:
        """Compute a turn's first half without changing any bot."""
        batch, n_queries = company.batch, self.bundle.manifest.features.n_queries
        batch.begin(request[0], returns_to_go_N, means.terms.target_cost_N)
        noise_NX = self._contexts.noise(batch)
        drawn = draw(self._policy, batch, noise_NX, means, frame_budget_us, self._clock)
        for array in (drawn.query_NM, drawn.cost_us_N, drawn.probs_NM):
            array.flags.writeable = False
        queries = Queries(frame, drawn.query_NM, drawn.cost_us_N, drawn.probs_NM, drawn.infer_us)
        budget_us = means.budget_us if frame_budget_us is None else min(means.budget_us, frame_budget_us)
        return Turn(frame, company.handles_N, request, queries, noise_NX[:, n_queries:], drawn.asks_N, budget_us)


def _check_same(content: tuple[NDArray[np.generic], ...], kept: tuple[NDArray[np.generic], ...], frame: int) -> None:
    if not all(np.array_equal(new, old) for new, old in zip(content, kept, strict=True)):
        raise FrameReused(f"frame {frame} was sent before with other content")
