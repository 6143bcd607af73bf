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
from bot_runtime.asking import Asking
from bot_runtime.batch import Batch
from bot_runtime.bundle import Bundle
from bot_runtime.company import Companies, Company
from bot_runtime.context import Contexts
from bot_runtime.costs import MAX_ACQUIRE_US, Costs
from bot_runtime.deadline import Deadline
from bot_runtime.fallback import Counters
from bot_runtime.haste import Haste
from bot_runtime.policy import Policy
from bot_runtime.request import NOTHING_SAID, Numbers, Request
from bot_runtime.slots import Slots
from bot_runtime.spending import Limits, Spending
from bot_runtime.spent import Spent
from bot_runtime.step import Chance, Step
from bot_runtime.turns import UNMEASURED, Actions, Queries, Turn, Turns
from protocol.errors import BadSchema, FrameReused
from protocol.features import CostModel
from protocol.messages import MAX_RETURN, MAX_RETURN_TO_GO
from protocol.turn import Event
from protocol.values import check_frame

__all__ = ["Bots"]

_Handles = NDArray[np.int64]
_Floats = NDArray[np.float64]


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
        self.haste = Haste(clock)
        self._clock = clock
        self._policy = Policy(bundle)
        generation = secrets.randbits(31) if first_generation is None else first_generation
        self._slots = Slots(max_bots, first_generation=generation)
        self._contexts = Contexts(bundle.manifest, max_bots)
        self._turns = Turns(max_bots, self.counters)
        self._asking = Asking(bundle.manifest.features.n_queries, self._contexts, self.haste, clock)
        self._step = Step(bundle.manifest, self._contexts, self.counters, self.haste, clock)
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
        manifest = self.bundle.manifest
        model = cost_model or CostModel.declared(manifest.features)
        inputs.check_costs(model, manifest.features)
        returns_N = np.full(count, manifest.target_return)
        if target_returns is not None:
            returns_N = inputs.per_bot("target_returns", target_returns, count, -MAX_RETURN, MAX_RETURN)
        limits = Limits.checked(count, budgets_us, target_costs_us)
        numbered = range(self._started, self._started + count)
        seeds_N = inputs.seeds(numbered if seeds is None else seeds, count)
        turns_N = None if turns is None else inputs.turns(turns, count)
        slots_N = self._slots.take(count)
        self._started += count
        self._contexts.begin(slots_N, seeds_N, returns_N, turns_N)
        self._spending.begin(slots_N, model, limits)
        return self._slots.handles(slots_N)

    def request_queries(
        self,
        handles: _Handles,
        frame: int,
        free_NF: NDArray[np.float32],
        rewards_N: Numbers = None,
        frame_budget_us: float | None = None,
        budgets_us: Numbers = None,
        target_costs_us: Numbers = None,
        costs: Costs | None = None,
        deadline: Deadline | None = None,
    ) -> Queries:
        """What each bot asks for in this frame, within its own budget and, together, within `frame_budget_us`.

        `rewards_N` came since each bot's last frame and leave its return-to-go, once. `budgets_us` and
        `target_costs_us`, one number a bot, replace those of the bots' start for this frame only; how they make the
        network's target cost is `Spending.terms`. `costs`, as the bots' engine measures them, replace those of their
        start for this frame. A newer frame abandons a pending query. What cannot be decided by the `deadline` asks for
        nothing, and says why. Raises BadShape, BadSchema, NoBot, StaleFrame, FrameReused, NonFinite, OutOfRange;
        NotReady where the deadline passed before this began.
        """
        company = self._companies.named(handles, NOTHING_SAID)
        check_frame(frame)
        retried = self._turns.begun(company, frame, Event.QUERY)
        said = self._request(company, free_NF, rewards_N, frame_budget_us, budgets_us, target_costs_us, costs)
        if retried is not None:
            _check_same(said.content, retried.request, frame)
            return retried.queries
        returns_to_go_N = self._contexts.returns_to_go(company.batch) - said.rewards_N
        turn = self._asking.ask(self._policy, company, frame, said, returns_to_go_N, deadline)
        self._contexts.spend(company.batch, returns_to_go_N)
        if turn.is_prepared:
            company.batch.keep_prepared()
        self._turns.begin(company, turn)
        self.spent.ask(turn.queries.cost_us_N, min(said.means.allowed_us, turn.budget_us))
        self.counters.count_queries(company.n_bots, turn.queries.reasons_N)
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
        deadline: Deadline | None = None,
    ) -> Actions:
        """Answer the pending query of exactly these bots, in its order, and get their actions.

        `costly_ND` is dense; numbers of features that were not acquired, or are marked failed, are never looked at.
        `acquire_us` is what acquiring took for all of these bots; `costs` learn from it, once a turn. What cannot be
        decided by the `deadline` is the last action or a safe one, and no context advances.
        Raises BadShape, BadSchema, NoBot, StaleFrame, NoPendingQuery, UnrequestedFeature, MissingFeature, NonFinite,
        OutOfRange, FrameReused; NotReady where the deadline passed before this began.
        """
        company = self._companies.named(handles, NOTHING_SAID)
        check_frame(frame)
        turn, batch = self._turns.features(company, frame), company.batch
        staged_ND = batch.costly_ND if turn.actions is None else np.empty_like(batch.costly_ND)
        query_NM = turn.queries.query_NM
        known_NM = self._checks.costly(acquired_NM, costly_ND, failed_NM, query_NM, handles, staged_ND)
        measured_us = _measured(acquire_us)
        if turn.actions is not None:
            kept = (*self._contexts.acquired(batch), turn.measured_us)
            _check_same((staged_ND, known_NM, measured_us), kept, frame)
            return turn.actions
        chance = self._step.weigh(turn, batch, deadline)
        return self._answer(turn, batch, chance, acquired_NM, known_NM, measured_us, costs)

    def take_turn(
        self,
        handles: _Handles,
        frame: int,
        free_NF: NDArray[np.float32],
        acquired_NM: NDArray[np.bool_],
        costly_ND: NDArray[np.float32],
        failed_NM: NDArray[np.bool_] | None = None,
        rewards_N: Numbers = None,
        frame_budget_us: float | None = None,
        budgets_us: Numbers = None,
        target_costs_us: Numbers = None,
        acquire_us: float | None = None,
        costs: Costs | None = None,
        replayed_returns_to_go: Numbers = None,
        deadline: Deadline | None = None,
    ) -> Actions:
        """Both halves at once, where the engine has decided what to acquire: what it acquired or failed is the query.

        The same as a query that came out so and its features. Where `replayed_returns_to_go` is given, the turn was
        taken before, at a server that is gone, and each bot then had so much left: what it has now stays, and budgets
        are not looked at. Raises what the halves raise (but NoPendingQuery and what compares with a query), OverBudget.
        """
        company = self._companies.named(handles, NOTHING_SAID)
        check_frame(frame)
        retried, batch = self._turns.begun(company, frame, Event.TURN), company.batch
        known = costs if costs is not None and costs.n_frames else None  # else those of the bots' start, at hand
        said = self._request(company, free_NF, rewards_N, frame_budget_us, budgets_us, target_costs_us, known)
        left_N, replayed_N = self._left(company, said, rewards_N, replayed_returns_to_go)
        query_NM, staged_ND = self._checks.query(acquired_NM, failed_NM, handles), np.empty_like(batch.costly_ND)
        known_NM = self._checks.costly(acquired_NM, costly_ND, failed_NM, query_NM, handles, staged_ND)
        measured_us, request = _measured(acquire_us), (*said.content, query_NM, replayed_N)
        if retried is not None and retried.actions is not None:
            kept = (*retried.request, *self._contexts.acquired(batch), retried.measured_us)
            _check_same((*request, staged_ND, known_NM, measured_us), kept, frame)
            return retried.actions
        cost_us_N = said.means.cost_us(query_NM)
        if not replayed_N.size:
            said.means.check(cost_us_N, said.limits.frame_budget_us)
        turn = self._asking.decided(company, frame, said, left_N, query_NM, cost_us_N)
        turn.request = request
        chance = self._step.weigh(turn, batch, deadline)  # nothing is refused from here on
        np.copyto(batch.costly_ND, staged_ND)
        actions = self._answer(turn, batch, chance, acquired_NM, known_NM, measured_us, costs)
        if not replayed_N.size:
            self._contexts.spend(batch, left_N)
            self.spent.ask(cost_us_N, min(said.means.allowed_us, turn.budget_us))
        self._turns.begin(company, turn)
        return actions

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

    def probe(self, n_bots: int) -> float:
        """Run both graphs for so many bots, on zeros, touching none; how many µs that took. From any thread."""
        started_ns = self._clock()
        self._policy.check_batch(n_bots)
        return (self._clock() - started_ns) / 1e3

    def _request(self, company: Company, *said: Any) -> Request:
        return Request.checked(self._checks, self._spending, company, *said)

    def _left(self, company: Company, request: Request, rewards: Numbers, replayed: Numbers) -> tuple[_Floats, _Floats]:
        """What each bot has left in a turn, [N], and what the message says of that: [N], empty where nothing."""
        if replayed is None:
            return self._contexts.returns_to_go(company.batch) - request.rewards_N, np.zeros(0)
        if rewards is not None:
            raise BadSchema("rewards came with replayed_returns_to_go, which has counted them")
        limit = MAX_RETURN_TO_GO
        replayed_N = inputs.per_bot("replayed_returns_to_go", replayed, company.n_bots, -limit, limit)
        return replayed_N, replayed_N

    def _answer(
        self,
        turn: Turn,
        batch: Batch,
        chance: Chance,
        acquired_NM: NDArray[np.bool_],
        known_NM: NDArray[np.bool_],
        measured_us: _Floats,
        costs: Costs | None,
    ) -> Actions:
        """Act on what was staged as acquired and is known, and learn what acquiring cost."""
        np.copyto(batch.query_NM, known_NM)
        actions = self._step.act(self._policy, turn, batch, chance)
        turn.actions, turn.measured_us = actions, measured_us
        batch.keep_acquired()
        if measured_us.size and costs is not None:
            acquire_us = float(measured_us[0])
            predicted_us = costs.observe(acquired_NM, acquire_us)
            if predicted_us is not None:
                self.spent.measure(acquire_us, predicted_us, turn.budget_us)
        return actions


def _measured(acquire_us: float | None) -> _Floats:
    """[1], or empty where nothing was measured. Raises NonFinite, OutOfRange."""
    return UNMEASURED if acquire_us is None else inputs.per_bot("acquire_us", (acquire_us,), 1, 0.0, MAX_ACQUIRE_US)


def _check_same(content: tuple[NDArray[np.generic], ...], kept: tuple[NDArray[np.generic], ...], frame: int) -> None:
    if not all(np.array_equal(new, old) for new, old in zip(content, kept, strict=True)):
        raise FrameReused(f"frame {frame} was sent before with other content")
