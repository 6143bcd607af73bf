"""Turns of several connections that wait together: one batch, and otherwise as if each had been answered alone."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.together import MAX_BOTS_EACH
from protocol.client import BotClient
from protocol.codec import Format
from server.answer import Answer, Arrival
from server.connections import Connections
from server.desk import Desk
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from server.worker import Worker
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE
from tests.server.serving import free_numbers, play, serve

N = 2


class Engines:
    """Connections at one desk; each names bundle `bundles[i]`, and has bots that took a turn before."""

    def __init__(self, desk: Desk, worker: Worker) -> None:
        self.desk, self.worker = desk, worker
        self.connections: list[str] = []
        self.bots: list[list[int]] = []

    async def open(self, bundle: str, n_bots: int = N) -> None:
        welcome = await self._said({"type": "hello", "bundle": bundle}, None)
        started = await self._said(
            {"type": "start_bots", "count": n_bots, "seeds": [*range(n_bots)]}, welcome["connection"]
        )
        self.connections.append(welcome["connection"])
        self.bots.append(started["bots"])
        await self.told(self.put(len(self.bots) - 1, 0))
        await asyncio.sleep(0)  # so that this look ends

    def put(self, engine: int, frame: int, **changes: object) -> Answer | asyncio.Future[Answer]:
        bots = self.bots[engine]
        free = free_numbers(TABLE, len(bots), frame).tobytes()
        message = {"type": "request_queries", "frame": frame, "bots": bots, "free": free, **changes}
        return self._put(message, self.connections[engine])

    async def told(self, answered: Answer | asyncio.Future[Answer]) -> dict[str, Any]:
        return msgpack.unpackb((answered if isinstance(answered, Answer) else await answered).body)

    def _put(self, message: dict[str, object], connection: str | None) -> Answer | asyncio.Future[Answer]:
        return self.desk.ask(msgpack.packb(message), Format.MSGPACK, connection, Arrival.now("tcp"))

    async def _said(self, message: dict[str, object], connection: str | None) -> dict[str, Any]:
        return await self.told(self._put(message, connection))

    def counts(self) -> list[list[int]]:
        """Of each bundle: how often 2, up to 4 and more were one batch."""
        return [serving.bots.together.counts[:3] for serving in self.desk.handlers.servings]


@pytest.fixture(scope="module")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> list[Bundle]:
    folder = tmp_path_factory.mktemp("named")
    return [Bundle.load(make_bundle(folder / name, features=TABLE, name=name)) for name in ("one", "two")]


@pytest.fixture
def at(bundles: list[Bundle]) -> Callable[..., None]:
    """Run a test on engines of the bundles "one" and "two" at a desk that joins up to so many."""

    def run(test: Callable[[Engines], Coroutine[Any, Any, None]], most: int = 4) -> None:
        async def main() -> None:
            servings, worker = Servings(max_bots=64), Worker(max_queue=16)
            for bundle in bundles:
                servings.activate(Serving(bundle, max_bots=64))
            handlers = Handlers(servings, Connections(8, 60.0), None)
            try:
                await test(Engines(Desk(handlers, worker, inline_us=1e9, batch_connections=most), worker))
            finally:
                worker.close()

        asyncio.run(main())

    return run


def test_a_bad_one_among_them_is_refused_alone(at: Callable[..., None]) -> None:
    async def test(engines: Engines) -> None:
        for _ in range(4):
            await engines.open("one")
        nan = np.full((N, TABLE.n_free), np.nan, dtype="<f4").tobytes()
        asked = [engines.put(0, 1), engines.put(1, 1), engines.put(2, 1, free=nan), engines.put(3, 1)]
        assert isinstance(asked[0], Answer)  # nothing waits for company
        replies = [await engines.told(each) for each in asked]
        assert [reply.get("code", reply["type"]) for reply in replies] == [*2 * ["queries"], "NON_FINITE", "queries"]
        assert replies[0]["queries"] == replies[1]["queries"] == replies[3]["queries"]  # the same seeds and numbers
        assert engines.counts() == [[1, 0, 0], [0, 0, 0]]
        assert (await engines.told(engines.put(2, 1)))["queries"] == replies[0]["queries"]

    at(test)


def test_no_more_than_asked_for_and_none_of_another_bundle_or_too_large(at: Callable[..., None]) -> None:
    async def test(engines: Engines) -> None:
        for bundle in ("one", "one", "two", "one", "two", "one"):
            await engines.open(bundle)
        await engines.open("one", MAX_BOTS_EACH + 1)
        replies = [await engines.told(each) for each in [engines.put(engine, 1) for engine in range(7)]]
        assert {reply["type"] for reply in replies} == {"queries"}
        assert engines.counts() == [[1, 0, 0], [1, 0, 0]]

    at(test, most=2)


def test_two_requests_of_one_connection_are_answered_in_their_order(at: Callable[..., None]) -> None:
    async def test(engines: Engines) -> None:
        for _ in range(2):
            await engines.open("one")
        asked = [engines.put(0, 1), engines.put(0, 2), engines.put(1, 1), engines.put(0, 1)]
        replies = [await engines.told(each) for each in asked]
        assert [reply.get("code", reply.get("frame")) for reply in replies] == [1, 2, 1, "STALE_FRAME"]
        assert engines.counts()[0] == [1, 0, 0]

    at(test)


def test_what_the_worker_has_begun_meanwhile_is_waited_for(at: Callable[..., None]) -> None:
    async def test(engines: Engines) -> None:
        for _ in range(3):
            await engines.open("one")
        asked, gate = [engines.put(engine, 1) for engine in range(3)], threading.Event()
        engines.worker.post(gate.wait)
        for _ in range(9):  # both have had their turn in the line then
            await asyncio.sleep(0)
        assert not any(each.done() for each in asked[1:])
        gate.set()
        replies = [await engines.told(each) for each in asked]
        assert [reply["type"] for reply in replies] == 3 * ["queries"]
        assert engines.counts()[0] == [0, 0, 0]

    at(test)


def test_a_deadline_is_each_ones_own(at: Callable[..., None]) -> None:
    async def test(engines: Engines) -> None:
        for _ in range(3):
            await engines.open("one")
        asked = [engines.put(0, 1), engines.put(1, 1, deadline_us=1.0), engines.put(2, 1, deadline_us=1e7)]
        replies = [await engines.told(each) for each in asked]
        assert replies[1].get("code") == "NOT_READY" or replies[1]["reasons"]
        assert [reply["type"] for reply in replies[::2]] == ["queries", "queries"]
        assert not any(reply.get("reasons") for reply in replies[::2])

    at(test)


def test_engines_at_once_over_sockets_act_as_alone(bundles: list[Bundle], tmp_path: Path) -> None:
    def episode(address: str) -> list[np.ndarray]:
        with BotClient(address) as client:
            client.hello()
            bots = client.start(N, seeds=[3, 4])
            return [actions.actions for actions in play(client, TABLE, bots, range(12))]

    folder = make_bundle(tmp_path / "one", features=TABLE, name="one")
    with (
        serve(folder, tmp_path / "s", max_bots=16, batch_connections=8) as served,
        ThreadPoolExecutor(4) as engines,
    ):
        together = list(engines.map(episode, [served.addresses["unix"]] * 4))
    with serve(folder, tmp_path / "s", max_bots=16) as served:
        alone = episode(served.addresses["unix"])
    for played in together:
        np.testing.assert_allclose(played, alone, atol=1e-5)
