"""Overruns and the breaker, by an injected clock: what opens it, and what does not."""

from __future__ import annotations

import pytest

from bot_runtime.breaker import OVERRUNS, PAUSES_NS
from bot_runtime.bundle import Bundle
from bot_runtime.deadline import LEAVE_US
from bot_runtime.fallback import Reason
from tests.bot_runtime.world import ROOM_US, N, World, answered_by_the_loop


@pytest.fixture
def world(bundle: Bundle) -> World:
    return World(bundle)


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
        actions = answered_by_the_loop(world, frame)
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
