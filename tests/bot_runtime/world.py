"""A world whose graphs take as long as told, by an injected clock, and what plays in it."""

from __future__ import annotations

from collections.abc import Callable

from bot_runtime.batch import Batch
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.deadline import Deadline
from bot_runtime.policy import Policy
from bot_runtime.turns import Actions, Queries
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


def answered_by_the_loop(world: World, frame: int) -> Actions:
    queries, deadline = world.ask(frame), world.deadline(ROOM_US)
    world.slow.meanwhile = deadline.expire
    actions = world.submit(frame, queries, deadline)
    world.slow.meanwhile = lambda: None
    assert actions is deadline.fallback
    return actions
