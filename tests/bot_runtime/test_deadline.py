"""Deadlines, by an injected clock: who answers, what is answered, and what a bot remembers of it."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from bot_runtime.batch import Batch
from bot_runtime.bots import Bots
from bot_runtime.breaker import OVERRUNS, PAUSES_NS
from bot_runtime.bundle import Bundle
from bot_runtime.deadline import LEAVE_US, Deadline
from bot_runtime.fallback import Cause, Reason
from bot_runtime.policy import Policy
from bot_runtime.turns import Actions, Queries
from protocol.errors import FrameReused, NotReady
from tests.bot_runtime.conftest import Engine
from tests.bot_runtime.test_durations import Clock

N = 3
ROOM_US = 10_000.0


class Slow:
    """A policy whose graphs take as long as the test says; `meanwhile` is what others do during that time."""

    def __init__(self, policy: Policy, clock: Clock) -> None:
        self._policy, self._clock = policy, clock
        self.us = {"query_probs": 10.0, "act": 10.0}
        self.ran: list[str] = []
        self.meanwhile: Callable[[], object] = lambda: None

    def query_probs(self, batch: Batch) -> None:
        self._policy.query_probs(batch)
        self._pass("query_probs")

    def act(self, batch: Batch) -> None:
        self._policy.act(batch)
        self._pass("act")

    def _pass(self, graph: str) -> None:
        self._clock.ns += int(self.us[graph] * 1e3)
        self.ran.append(graph)
        self.meanwhile()


class World:
    """Bots on a clock of their own, and what their engine gets."""

    def __init__(self, bundle: Bundle) -> None:
        self.clock = Clock()
        self.engine = Engine(Bots(bundle, max_bots=2 * N, clock=self.clock))
        self.bots = self.engine.bots
        self.slow = self.bots._policy = Slow(self.bots._policy, self.clock)
        self.handles = self.bots.start(N, seeds=[1, 2, 3])

    def deadline(self, limit_us: float) -> Deadline:
        return Deadline(self.clock(), limit_us, self.clock)

    def ask(self, frame: int, limit_us: float | None = ROOM_US) -> Queries:
        return self.engine.ask(self.handles, frame, deadline=None if limit_us is None else self.deadline(limit_us))

    def submit(self, frame: int, queries: Queries, deadline: Deadline | None = None, seed: int = 0) -> Actions:
        costly = self.engine.costly(frame + seed, N)
        return self.bots.submit_features(self.handles, frame, queries.query_NM, costly, deadline=deadline)

    def turn(self, frame: int) -> bytes:
        queries = self.ask(frame)
        actions = self.submit(frame, queries, self.deadline(ROOM_US))
        assert queries.reasons_N is None
        assert not actions.reasons_N.any()
        return queries.query_NM.tobytes() + queries.probs_NM.tobytes() + actions.action_NA.tobytes()


@pytest.fixture(params=["tiny", "memoryless", "conditioned"])
def worlds(
    request: pytest.FixtureRequest, bundle: Bundle, memoryless: Bundle, conditioned: Bundle
) -> tuple[World, World]:
    """The same twice: one whose turns go wrong, one for what should come of it."""
    served = {"tiny": bundle, "memoryless": memoryless, "conditioned": conditioned}[request.param]
    return World(served), World(served)


@pytest.fixture
def world(bundle: Bundle) -> World:
    return World(bundle)


def test_a_deadline_that_is_kept_changes_nothing(worlds: tuple[World, World]) -> None:
    world, clean = worlds
    assert [world.turn(frame) for frame in range(8)] == clean.engine.play(clean.handles, range(8))
    assert world.bots.counters.query_reasons[Reason.LEARNED] == 8 * N


def _overrun(world: World, frame: int) -> Actions:
    queries = world.ask(frame)
    world.slow.us["act"] = ROOM_US
    actions = world.submit(frame, queries, world.deadline(ROOM_US))
    world.slow.us["act"] = 10.0
    world.clock.ns += 2 * 10**9  # what follows is not to be shed for it
    return actions


def _shed(world: World, frame: int) -> Actions:
    queries, ran = world.ask(frame), len(world.slow.ran)
    actions = world.submit(frame, queries, world.deadline(LEAVE_US - 1.0))
    assert len(world.slow.ran) == ran
    return actions


def _answered_by_the_loop(world: World, frame: int) -> Actions:
    queries, deadline = world.ask(frame), world.deadline(ROOM_US)
    world.slow.meanwhile = deadline.expire
    actions = world.submit(frame, queries, deadline)
    world.slow.meanwhile = lambda: None
    assert actions is deadline.fallback
    return actions


@pytest.mark.parametrize(
    ("miss", "cause"),
    [(_overrun, Cause.DEADLINE), (_shed, Cause.SHED), (_answered_by_the_loop, Cause.DEADLINE)],
)
def test_a_missed_act_is_the_last_action_and_the_context_does_not_advance(
    worlds: tuple[World, World], miss: Callable[[World, int], Actions], cause: Cause
) -> None:
    """The bots play on as bots do whose pending query was abandoned at that frame."""
    world, clean = worlds
    first = miss(world, 0)
    assert first.reasons_N.tolist() == [cause + 2] * N
    safe = world.bots.bundle.manifest.action.safe
    assert first.action_NA.tolist() == [safe.tolist()] * N
    clean.ask(0)
    for frame in range(1, 6):
        assert world.turn(frame) == clean.turn(frame)
    last = world.bots._contexts.last_action(world.bots._companies.named(world.handles, None).batch).copy()
    missed = miss(world, 6)
    assert missed.reasons_N.tolist() == [cause + 1] * N
    assert np.array_equal(missed.action_NA, last)
    clean.ask(6)
    assert [world.turn(frame) for frame in range(7, 15)] == [clean.turn(frame) for frame in range(7, 15)]
    assert world.bots.counters.reasons[Reason(cause + 1)] == N
    assert world.bots.counters.reasons[Reason(cause + 2)] == N


@pytest.mark.parametrize("miss", [_overrun, _shed, _answered_by_the_loop])
def test_a_retry_of_a_missed_act_is_the_same_answer(world: World, miss: Callable[[World, int], Actions]) -> None:
    world.turn(0)
    missed = miss(world, 1)
    queries, ran = world.ask(1), len(world.slow.ran)
    for deadline in (None, world.deadline(0.0), world.deadline(ROOM_US)):
        assert world.submit(1, queries, deadline) is missed
    if queries.query_NM.any():
        with pytest.raises(FrameReused):
            world.submit(1, queries, seed=50)
    assert len(world.slow.ran) == ran


def test_a_shed_query_asks_for_nothing_and_its_action_is_learned_from_free_features(
    worlds: tuple[World, World],
) -> None:
    """As if nothing had been affordable in that frame."""
    world, clean = worlds
    for frame in range(6):
        shed = frame % 3 == 1
        queries = world.ask(frame, 0.0 if shed else ROOM_US)
        if shed:
            assert queries.reasons_N.tolist() == [Reason.SHED_QUERY] * N
            assert not queries.query_NM.any()
            assert not queries.cost_us_N.any()
        asked = clean.engine.ask(clean.handles, frame)
        none = np.zeros_like(asked.query_NM)
        wanted = clean.bots.submit_features(
            clean.handles, frame, none if shed else asked.query_NM, clean.engine.costly(frame, N),
            failed_NM=asked.query_NM if shed else None,
        )  # fmt: skip
        actions = world.submit(frame, queries, world.deadline(ROOM_US))
        assert actions.reasons_N.tolist() == [Reason.SHED_QUERY if shed else Reason.LEARNED] * N
        assert np.array_equal(actions.action_NA, wanted.action_NA)
    assert world.bots.counters.query_reasons[Reason.SHED_QUERY] == 2 * N
    assert world.bots.counters.reasons[Reason.SHED_QUERY] == 2 * N


def test_a_query_that_takes_too_long_asks_for_nothing(worlds: tuple[World, World]) -> None:
    world, clean = worlds
    world.slow.us["query_probs"] = ROOM_US
    queries = world.ask(0)
    assert queries.reasons_N.tolist() == [Reason.DEADLINE_QUERY] * N
    assert world.ask(0) is queries
    asked = clean.ask(0)
    wanted = clean.bots.submit_features(
        clean.handles, 0, np.zeros_like(asked.query_NM), clean.engine.costly(0, N), asked.query_NM
    )
    actions = world.submit(0, queries, world.deadline(ROOM_US))
    assert actions.reasons_N.tolist() == [Reason.DEADLINE_QUERY] * N
    assert np.array_equal(actions.action_NA, wanted.action_NA)


def test_what_is_predicted_not_to_fit_is_shed_until_the_measurement_is_old(world: World) -> None:
    world.slow.us["act"] = 2 * ROOM_US
    reasons = []
    for frame in range(4):
        world.clock.ns += 400_000_000
        actions = world.submit(frame, world.ask(frame), world.deadline(ROOM_US))
        reasons.append(Reason(actions.reasons_N[0]))
    shed = Reason.SHED_SAFE_ACTION
    assert reasons == [Reason.DEADLINE_SAFE_ACTION, shed, shed, Reason.DEADLINE_SAFE_ACTION]


def test_a_refused_request_is_refused_by_the_bots_too_and_changes_nothing(worlds: tuple[World, World]) -> None:
    """The deadline passed while it waited: whoever waits has refused it before the bots see it."""
    world, clean = worlds
    for frame in range(4):
        late = world.deadline(ROOM_US)
        assert late.expire()
        assert late.fallback is None
        with pytest.raises(NotReady):
            world.engine.ask(world.handles, frame, deadline=late)
        queries = world.ask(frame)
        with pytest.raises(NotReady):
            world.submit(frame, queries, late)
        played = queries.query_NM.tobytes() + queries.probs_NM.tobytes()
        played += world.submit(frame, queries).action_NA.tobytes()
        assert played == clean.turn(frame)


def test_three_overruns_open_the_breaker_and_then_nothing_is_inferred(world: World) -> None:
    for frame in range(3):
        world.turn(frame)
    world.slow.us["act"] = ROOM_US
    for frame in range(3, 3 + OVERRUNS):
        world.clock.ns += 2 * 10**9  # so that none is shed
        assert not world.bots.haste.breaker.is_open
        world.submit(frame, world.ask(frame), world.deadline(ROOM_US))
    breaker, ran = world.bots.haste.breaker, len(world.slow.ran)
    assert breaker.is_open
    queries = world.ask(8, None)
    actions = world.submit(8, queries)
    assert queries.reasons_N.tolist() == [Reason.BREAKER_QUERY] * N
    assert actions.reasons_N.tolist() == [Reason.BREAKER_LAST_ACTION] * N
    assert len(world.slow.ran) == ran
    world.slow.us["act"] = 10.0
    world.clock.ns += PAUSES_NS[0]
    assert breaker.due() is not None
    breaker.probed(20.0)
    world.clock.ns += 10**9  # what took so long is not predicted any more
    world.turn(9)


def test_quick_graphs_open_no_breaker_whoever_answered(world: World) -> None:
    """The loop's timer may be early, and the worker may have waited for the machine before and after its graphs."""
    for frame in range(3):
        world.turn(frame)
    for frame in range(3, 3 + 4 * OVERRUNS):
        actions = _answered_by_the_loop(world, frame)
        assert actions.reasons_N.tolist() == [Reason.DEADLINE_LAST_ACTION] * N
    assert world.bots.haste.breaker.n_opened == 0


def test_a_bundle_that_is_as_fast_as_ever_passes_its_probe_whatever_the_last_overrun_was_allowed(world: World) -> None:
    """A probe runs both graphs; what overran may have been the small one, allowed less than both take."""
    world.slow.us["act"] = 400.0
    for frame in range(3):
        world.turn(frame)
    world.slow.us["query_probs"] = 500.0
    for frame in range(3, 3 + OVERRUNS):
        world.clock.ns += 2 * 10**9  # so that none is shed
        world.ask(frame, LEAVE_US + 100.0)
    breaker = world.bots.haste.breaker
    assert breaker.is_open
    breaker.probed(410.0)
    assert not breaker.is_open


def test_a_deadline_that_no_machine_keeps_opens_no_breaker(world: World) -> None:
    """One engine's impossible deadline must not take the bots of the others."""
    world.slow.us = {"query_probs": 100.0, "act": 100.0}
    for frame in range(20):
        world.clock.ns += 2 * 10**9
        actions = world.submit(frame, world.ask(frame, None), world.deadline(LEAVE_US + 50.0))
        assert actions.reasons_N[0] == Reason.DEADLINE_SAFE_ACTION
    assert not world.bots.haste.breaker.is_open


def test_exactly_one_of_two_threads_answers() -> None:
    for _ in range(200):
        clock = Clock()
        deadline, start, answered = Deadline(0, ROOM_US, clock), threading.Barrier(2), []

        def one(answer: Callable[[], bool], name: str, start=start, answered=answered) -> None:
            start.wait()
            if answer():
                answered.append(name)

        threads = [
            threading.Thread(target=one, args=(answer, answer.__name__)) for answer in (deadline.take, deadline.expire)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(answered) == 1


def test_after_an_offer_only_the_offer_can_be_answered_at_the_deadline() -> None:
    deadline = Deadline(0, ROOM_US, Clock())
    deadline.offer("fallback")
    assert deadline.expire()
    assert deadline.fallback == "fallback"
    assert not deadline.take()
    assert not deadline.expire()


def test_the_clock_may_stand_anywhere_and_what_counts_is_what_has_passed() -> None:
    for now in (0, 10**18):
        clock = Clock()
        clock.ns = now
        deadline = Deadline(clock(), 1000.0, clock)
        assert deadline.left_us() == 1000.0 - LEAVE_US
        clock.ns += 1_000_000
        assert not deadline.is_over
        clock.ns += 1
        assert deadline.is_over
