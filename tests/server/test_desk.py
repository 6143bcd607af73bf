"""What is answered on the event loop and what is not, on real bots; processor time is a number that the tests set."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgpack
import pytest

from protocol.errors import NotReady
from server.answer import Answer, Arrival
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE
from tests.server.counter import Counter, run_at_desk


@pytest.fixture
def at_desk(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Counter], object]], None]:
    return partial(run_at_desk, bundle, monkeypatch)


def test_a_turn_that_is_known_to_be_quick_stays_on_the_loop(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(8)
        assert [await counter.query(bots[:1]) for _ in range(3)] == [False, True, True]
        assert [await counter.query(bots) for _ in range(3)] == [False, True, True]  # another size, unknown at first
        assert [await counter.query(bots[:5]) for _ in range(3)] == [False, True, True]

    at_desk(test)


def test_what_was_answered_on_the_loop_is_counted_soon_after(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        recorder, bots = counter.desk.handlers.recorder, await counter.start(1)
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        for _ in range(4):
            await asyncio.sleep(0)
        assert not recorder._noted
        assert sum(histograms.bots for histograms in recorder._answers.values()) == 2

    at_desk(test)


def test_a_turn_that_becomes_slow_leaves_the_loop_and_comes_back(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        counter.us = 300.0
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        counter.us = 5000.0
        assert await counter.query(bots)  # nobody knew
        assert not any([await counter.query(bots) for _ in range(20)])
        counter.us = 300.0
        where = [await counter.query(bots) for _ in range(100)]
        assert not where[0]
        assert where[-1]

    at_desk(test)


def test_one_odd_measurement_changes_nothing(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        for counter.us in (100.0, 100.0, 50000.0, 100.0):
            await counter.query(bots)
        assert await counter.query(bots)

    at_desk(test)


def test_while_the_worker_is_busy_nothing_touches_the_bots_on_the_loop(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots, release = await counter.start(1), threading.Event()
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        holding = counter.worker.run(release.wait)
        first, second = (counter.put(counter.request(bots)) for _ in range(2))
        release.set()
        answers = [await first, await second]  # in their order: the second frame is the newer one
        assert [msgpack.unpackb(each.body)["type"] for each in answers] == ["queries", "queries"]
        assert threading.get_ident() not in counter.threads[-2:]
        await holding
        assert await counter.query(bots)

    at_desk(test)


def test_only_small_turns_and_refusals_are_answered_on_the_loop(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        for message in ({"type": "start_bots", "count": 1}, {"type": "stop_bots", "bots": bots}, {"type": "goodbye"}):
            assert (await counter.ask(message))[1] is False
        assert await counter.ask({"type": "hello", "unknown": 1}) == (
            {
                "type": "error",
                "code": "BAD_SCHEMA",
                "detail": "Object contains unknown field `unknown`",
                "retry_after_s": None,
            },
            True,
        )
        reply, inline = await counter.ask({"type": "hello", "token": "x" * 20000})
        assert (reply["code"], inline) == ("BAD_SCHEMA", False)

    at_desk(test)


def test_a_deadline_begins_no_earlier_than_its_connections_last_answer(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        counter.us = 300.0
        await counter.look_again()
        assert isinstance(counter.put(counter.request(bots, deadline_us=50_000.0)), Answer)
        now, connection = Arrival("tcp", counter.now_ns), counter.desk.handlers.connections.peek(counter.connection)
        assert connection is not None
        own, others = (counter.desk._due_by(now, 1000.0, each).deadline for each in (connection, None))
        assert connection.answered_ns == counter.now_ns
        assert own.due_ns == counter.now_ns + 1_000_000
        assert others.due_ns <= counter.now_ns + 700_000
        counter.us = 5000.0
        for _ in range(9):
            await counter.query(bots)  # the last by the worker
        await counter.look_again()
        assert threading.get_ident() != counter.threads[-1]
        assert connection.answered_ns == counter.now_ns

    at_desk(test)


def test_where_nothing_waits_nobody_is_refused(at_desk: Callable[..., None], monkeypatch: pytest.MonkeyPatch) -> None:
    async def test(counter: Counter) -> None:
        bots, release = await counter.start(1), threading.Event()
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        monkeypatch.setattr(counter.desk.due, "refusal_of", lambda *_, **__: NotReady("no time", retry_after_s=0.1))
        await counter.look_again()
        reply, _ = await counter.ask(counter.request(bots, deadline_us=50_000.0))
        assert reply["type"] == "queries"
        holding = counter.worker.run(release.wait)
        reply, _ = await counter.ask(counter.request(bots, deadline_us=50_000.0))
        assert reply["code"] == "NOT_READY"
        release.set()
        await holding

    at_desk(test)


def test_a_slow_bundle_beside_a_fast_one_never_borrows_its_pace(at_desk: Callable[..., None], tmp_path: Path) -> None:
    async def test(counter: Counter) -> None:
        slow = counter.serving(make_bundle(tmp_path / "slow", name="slow", features=TABLE))
        counter.desk.handlers.servings.activate(slow)
        fast_bots = await counter.start(1, "tiny")
        fast = counter.connection
        assert [await counter.query(fast_bots) for _ in range(3)] == [False, True, True]
        bots = await counter.start(1, "slow")
        counter.us = 5000.0
        assert not any([await counter.query(bots) for _ in range(5)])
        counter.us, counter.connection = 10.0, fast
        assert await counter.query(fast_bots)

    at_desk(test)
