"""Missed deadlines, by an injected clock: what is answered, and what a bot remembers of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.deadline import LEAVE_US
from bot_runtime.fallback import Cause, Reason
from bot_runtime.turns import Actions
from protocol.errors import FrameReused, NotReady
from tests.bot_runtime.world import ROOM_US, N, World, answered_by_the_loop


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


@pytest.mark.parametrize(
    ("miss", "cause"),
    [(_overrun, Cause.DEADLINE), (_shed, Cause.SHED), (answered_by_the_loop, Cause.DEADLINE)],
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


@pytest.mark.parametrize("miss", [_overrun, _shed, answered_by_the_loop])
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
