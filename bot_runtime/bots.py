"""Bots: the only stateful façade. Start bots, ask what each should acquire, submit it and get actions, stop bots.

Who they are is `bot_runtime.roster`'s; here they take their turns. This module knows nothing about bytes, sockets,
connections or time (but for the injected clock that measures inference). It is not thread-safe: one worker owns it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.acquired import Acquired
from bot_runtime.asking import Asking
from bot_runtime.batch import Batch
from bot_runtime.breaker import Probe
from bot_runtime.bundle import Bundle
from bot_runtime.company import Company
from bot_runtime.costs import Costs
from bot_runtime.deadline import Deadline
from bot_runtime.fallback import Counters
from bot_runtime.haste import Haste
from bot_runtime.policy import Policy
from bot_runtime.request import NOTHING_SAID, Numbers, Request
from bot_runtime.roster import Roster
from bot_runtime.spent import Spent
from bot_runtime.step import Chance, Step
from bot_runtime.together import Together
from bot_runtime.turns import Actions, Queries, Turn
from bot_runtime.work import Steps, alone
from protocol.errors import BadSchema
from protocol.messages import MAX_RETURN_TO_GO
from protocol.turn import Event
from protocol.values import check_frame

__all__ = ["Bots"]

_WARMING = 8  # runs of a probe at most
_HOPELESS = 20.0  # times what a probe may take: no cache makes up for that

_Handles = NDArray[np.int64]
_Floats = NDArray[np.float64]


class Bots(Roster):
    """All bots of one bundle in one process. A batch of N bots is the native shape; one bot is N = 1.

    Every refused call (any ProtocolError) leaves every bot exactly as it was. A repeated request with the same content
    gets the same reply object again and advances nothing; replies are read-only arrays. `counters` says how often
    each rung of the fallback ladder was used, `spent` what was asked for and what it really cost.

    A turn is taken in steps, which `together` runs for several messages at once, each with bots of its own. Alone, they
    are run before `request_queries`, `submit_features` or `take_turn` returns.
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
        self.counters = Counters()
        super().__init__(bundle.manifest, max_bots, self.counters, first_generation)
        self.bundle = bundle
        self.spent = Spent()
        self.haste = Haste(clock)
        self._clock = clock
        self._policy = Policy(bundle)
        self._asking = Asking(bundle.manifest.features.n_queries, self._contexts, self.haste, clock)
        self._step = Step(bundle.manifest, self._contexts, self.counters, self.haste, clock)
        self._checks = inputs.FeatureChecks(bundle.manifest.features, max_bots)
        self._request = partial(Request.checked, self._checks, self._spending)
        self.together = Together(self._contexts)

    def query_steps(
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
    ) -> Steps[Queries]:
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
            retried.check_same(said.content, retried.request)
            return retried.queries
        returns_to_go_N = self._contexts.returns_to_go(company.batch) - said.rewards_N
        turn = yield from self._asking.ask(self._policy, company, frame, said, returns_to_go_N, deadline)
        self._contexts.spend(company.batch, returns_to_go_N)
        if turn.is_prepared:
            company.batch.keep_prepared()
        self._turns.begin(company, turn)
        self.spent.ask(turn.queries.cost_us_N, min(said.means.allowed_us, turn.budget_us))
        self.counters.count_queries(company.n_bots, turn.queries.reasons_N)
        return turn.queries

    def feature_steps(
        self,
        handles: _Handles,
        frame: int,
        acquired_NM: NDArray[np.bool_],
        costly_ND: NDArray[np.float32],
        failed_NM: NDArray[np.bool_] | None = None,
        acquire_us: float | None = None,
        costs: Costs | None = None,
        deadline: Deadline | None = None,
    ) -> Steps[Actions]:
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
        found = Acquired.checked(
            self._checks, handles, query_NM, acquired_NM, costly_ND, failed_NM, acquire_us, staged_ND
        )
        if turn.actions is not None:
            turn.check_same(found.content, (*self._contexts.acquired(batch), turn.measured_us))
            return turn.actions
        chance = self._step.weigh(turn, batch, deadline)
        return (yield from self._answer(turn, batch, chance, found, costs))

    def turn_steps(
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
    ) -> Steps[Actions]:
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
        query_NM = self._checks.query(acquired_NM, failed_NM, handles)
        staged_ND = np.empty_like(batch.costly_ND)
        found = Acquired.checked(
            self._checks, handles, query_NM, acquired_NM, costly_ND, failed_NM, acquire_us, staged_ND
        )
        request = (*said.content, query_NM, replayed_N)
        if retried is not None and retried.actions is not None:
            kept = (*retried.request, *self._contexts.acquired(batch), retried.measured_us)
            retried.check_same((*request, *found.content), kept)
            return retried.actions
        cost_us_N = said.means.cost_us(query_NM)
        if not replayed_N.size:
            said.means.check(cost_us_N, said.limits.frame_budget_us)
        turn = self._asking.decided(company, frame, said, left_N, query_NM, cost_us_N)
        turn.request = request
        chance = self._step.weigh(turn, batch, deadline)  # nothing is refused from here on
        np.copyto(batch.costly_ND, found.costly_ND)
        actions = yield from self._answer(turn, batch, chance, found, costs)
        if not replayed_N.size:
            self._contexts.spend(batch, left_N)
            self.spent.ask(cost_us_N, min(said.means.allowed_us, turn.budget_us))
        self._turns.begin(company, turn)
        return actions

    request_queries, submit_features, take_turn = alone(query_steps), alone(feature_steps), alone(turn_steps)

    def probe(self, probe: Probe) -> float:
        """Run both graphs on zeros, touching no bot; how many µs of its time that took this thread.

        Not how long it waited for a processor: the probe must not fail for the load that others make. After a pause the
        first run finds nothing in the caches and takes several times as long as the turns that it is measured by, which
        follow each other: so there may be some before the one that counts. From any thread.
        """
        for _ in range(_WARMING):
            took_us = self._policy.check_batch(probe.n_bots, time.thread_time_ns)
            if took_us <= probe.allowed_us or took_us > _HOPELESS * probe.allowed_us:
                break
        return took_us

    def _left(self, company: Company, request: Request, rewards: Numbers, replayed: Numbers) -> tuple[_Floats, _Floats]:
        """What each bot has left in a turn, [N], and what the message says of that: [N], empty where nothing."""
        if replayed is None:
            return self._contexts.returns_to_go(company.batch) - request.rewards_N, np.zeros(0)
        if rewards is not None:
            raise BadSchema("rewards came with replayed_returns_to_go, which has counted them")
        limit = MAX_RETURN_TO_GO
        replayed_N = inputs.per_bot("replayed_returns_to_go", replayed, company.n_bots, -limit, limit)
        return replayed_N, replayed_N

    def _answer(self, turn: Turn, batch: Batch, chance: Chance, found: Acquired, costs: Costs | None) -> Steps[Actions]:
        """Act on what was staged as acquired and is known, and learn what acquiring cost."""
        np.copyto(batch.query_NM, found.known_NM)
        actions = yield from self._step.act(self._policy, turn, batch, chance)
        turn.actions, turn.measured_us = actions, found.measured_us
        batch.keep_acquired()
        if found.measured_us.size and costs is not None:
            acquire_us = float(found.measured_us[0])
            predicted_us = costs.observe(found.acquired_NM, acquire_us)
            if predicted_us is not None:
                self.spent.measure(acquire_us, predicted_us, turn.budget_us)
        return actions
