"""A server in memory, without sockets, that dies when it is told to; and an engine whose frames say all that can be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np

from bot_runtime.batch import Batch
from bot_runtime.bundle import Bundle
from bot_runtime.policy import Policy
from protocol.client import BotClient
from protocol.codec import Format
from protocol.features import CostModel, FeatureTable
from protocol.resuming import ResumingClient
from server.answer import Arrival, answer
from server.connections import Connections
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from tests.server.serving import costly_numbers, free_numbers

N = 3
SEEDS = [5, 2**63 - 1, 7]
MODEL = {"call_us": 3.3}


class Mortal:
    """Every server that there ever was at one address: the transport of a client, and what befalls it.

    `deaths` are numbers of requests, counted without those of resuming: the server dies before answering those whose
    value is "before", and after it has but before anyone hears of it where it is "after"; its follower is not there at
    once. Frames of `broken` come out of the network as NaN, for every bot or for the rows that they name.
    """

    def __init__(self, bundle: Bundle, deaths: dict[int, str], broken: dict[int, list[int]] | None = None) -> None:
        self.bundle, self.deaths, self._broken = bundle, deaths, broken or {}
        self.requests = self.lives = self.absent = 0
        self.absence = 2  # refused attempts between one and the next
        self.handlers = self._born()

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        """See Transport."""
        if self.absent:
            self.absent -= 1
            raise ConnectionRefusedError("nobody is there")
        message = msgpack.unpackb(body)
        death = self.deaths.pop(self.requests, None) if self._counts(message) else None
        self.requests += self._counts(message)
        if death == "before":
            self._die()
        replies = answer(self.handlers, body, Format.MSGPACK, connection, Arrival.now("tcp"))
        if death == "after":
            self._die()
        return replies.body

    def close(self) -> None:
        """See Transport."""

    def _counts(self, message: dict[str, Any]) -> bool:
        resuming = message["type"] in ("hello", "start_bots") or message.get("replayed_returns_to_go") is not None
        return not resuming

    def _die(self) -> None:
        self.handlers, self.absent = self._born(), self.absence
        raise ConnectionResetError("the server has died")

    def _born(self) -> Handlers:
        self.lives += 1
        servings, serving = Servings(8), Serving(self.bundle, max_bots=8)
        servings.activate(serving)
        bots = serving.bots
        bots._policy = Breaking(bots._policy, self._broken)
        for name in ("feature_steps", "turn_steps"):
            setattr(bots, name, _told(getattr(bots, name), bots._policy))
        return Handlers(servings, Connections(8, 1e9), None)


class Breaking:
    """A policy that computes NaN in some frames."""

    def __init__(self, policy: Policy, broken: dict[int, list[int]]) -> None:
        self._policy, self._broken, self.frame = policy, broken, -1
        self.query_probs = policy.query_probs

    def act(self, batch: Batch) -> None:
        self._policy.act(batch)
        rows = self._broken.get(self.frame, [])
        if batch.n_bots == N or len(rows) == N:
            batch.action_NA[[row for row in rows if row < batch.n_bots]] = np.nan


def _told(method: Callable[..., Any], policy: Breaking) -> Callable[..., Any]:
    def told(handles: np.ndarray, frame: int, *rest: Any) -> Any:
        policy.frame = frame
        return method(handles, frame, *rest)

    return told


def resuming(
    mortal: Mortal,
    clock: Callable[[], float] = lambda: 0.0,
    sleep: Callable[[float], object] = lambda pause_s: None,
) -> ResumingClient:
    """A client of it that waits by no clock, or by this one."""
    client = ResumingClient("tcp://127.0.0.1:1", clock=clock, sleep=sleep)
    client._client._transport = mortal
    return client


def plain(mortal: Mortal) -> BotClient:
    """A client of it that knows nothing of deaths."""
    client = BotClient("tcp://127.0.0.1:1")
    client._transport = mortal
    return client


def limits_of(frame: int) -> dict[str, Any]:
    """Different frames say different things of budgets."""
    return [{}, {"frame_budget_us": 25.0}, {"budgets_us": [4.0, 0.0, 30.0]}, {"target_costs_us": [2.0, 9.0, 1.0]}][
        frame % 4
    ]


def episode(client: BotClient | ResumingClient, table: FeatureTable, frames: range) -> list[bytes]:
    """Bots together, one alone, turns whole and in halves, failures, gaps, unanswered queries: all that came back."""
    model = CostModel(MODEL["call_us"], CostModel.declared(table).feature_us)
    client.hello(cost_model=model)
    bots = client.start(N, seeds=SEEDS, target_returns=[9.0, 20.0, -3.0], budgets_us=[20.0, 15.0, 1e6])
    lonely, played = client.start(1, seeds=[99], target_costs_us=[5.0]), []
    for frame in frames:
        if frame % 7 == 3:
            continue  # the engine skips it
        for named, seed in ((bots, frame), (lonely, frame + 1000)):
            n = len(named)
            random = np.random.default_rng(seed)
            rewards, limits = random.normal(0.5, 0.5, n), limits_of(frame) if n == N else {}
            free, costly = free_numbers(table, n, seed), costly_numbers(table, n, seed)
            queries = client.query(named, 2 * frame, free, rewards, **limits)
            played.append(queries.queries.tobytes() + queries.cost_us.tobytes())
            if frame % 5 == 1:
                continue  # the query is never answered
            failed = queries.queries & (random.random(queries.queries.shape) < 0.2)
            actions = client.act(named, 2 * frame, queries.queries & ~failed, costly, failed)
            played.append(actions.actions.tobytes() + actions.reasons.tobytes() + actions.turns.tobytes())
            whole = np.zeros_like(failed)
            whole[:, frame % 3] = True
            actions = client.take(named, 2 * frame + 1, free, whole & False, costly, rewards, whole & False, **limits)
            played.append(actions.actions.tobytes() + actions.reasons.tobytes() + actions.hidden.tobytes())
    return played
