"""Who waits for the event loop, who is refused at once and who is when its turn comes; time is what the tests set."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgpack
import pytest

from bot_runtime.deadline import LEAVE_US
from protocol.messages import Actions, Queries
from server.answer import Answer
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE
from tests.server.counter import Counter, run_at_desk


@pytest.fixture
def at_desk(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Counter], object]], None]:
    return partial(run_at_desk, bundle, monkeypatch)


def test_a_slow_bundle_refuses_no_deadline_of_a_fast_one(at_desk: Callable[..., None], tmp_path: Path) -> None:
    async def test(counter: Counter) -> None:
        slow = counter.serving(make_bundle(tmp_path / "slow", name="slow", features=TABLE))
        counter.desk.handlers.servings.activate(slow)
        bots, release = await counter.start(1, "slow"), threading.Event()
        counter.us = 5e6
        for _ in range(3):
            await counter.query(bots)
        counter.us, deadline_us, slow_connection = 10.0, 4e6, counter.connection
        fast_bots = await counter.start(1, "tiny")
        assert not await counter.query(fast_bots)
        holding = counter.worker.run(release.wait, 100.0)
        waiting = counter.put(counter.request(fast_bots, deadline_us))
        assert not isinstance(waiting, Answer)
        counter.connection = slow_connection
        refused = counter.put(counter.request(bots, deadline_us))
        assert isinstance(refused, Answer)
        assert refused.reply.code == "NOT_READY"
        release.set()
        assert isinstance((await waiting).reply, Queries)
        await holding

    at_desk(test)


def test_what_one_look_finds_is_answered_in_its_order_one_a_look(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        await asyncio.sleep(0)
        n_before = len(counter.threads)
        first, *others = (counter.put(counter.request(bots)) for _ in range(4))
        assert isinstance(first, Answer)
        assert len(counter.desk.looks) == 3
        for look in range(1, 4):
            await asyncio.sleep(0)
            assert len(counter.threads) - n_before == 1 + look
        answers = [first, *[await other for other in others]]
        frames = [msgpack.unpackb(each.body)["frame"] for each in answers]
        assert frames == sorted(frames)
        assert set(counter.threads[n_before:]) == {threading.get_ident()}

    at_desk(test)


def test_who_cannot_be_in_time_is_refused_when_it_is_read_and_features_sooner_have_a_place(
    at_desk: Callable[..., None],
) -> None:
    """Two wait, of 100 us each: what is new must have room for more than that, what was begun must not."""

    async def test(counter: Counter) -> None:
        counter.us = 100.0
        bots = await counter.start(8)
        for bot in bots[:4]:
            assert await counter.query([bot]) is (bot != bots[0])
            reply, inline = await counter.ask(counter.features([bot]))
            assert (reply["type"], inline) == ("actions", bot != bots[0])
        await counter.query(bots[:1])
        room_us = LEAVE_US + 2.25 * 100.0 + 100.0  # those who wait, its own
        features = counter.features(bots[:1], room_us)
        await asyncio.sleep(0)
        counter.advance_us(1e4)  # asleep
        first, *waiting = (counter.put(counter.request([bot])) for bot in bots[1:4])
        new, begun = counter.put(counter.request(bots[6:7], room_us)), counter.put(features)
        assert isinstance(new, Answer)
        assert new.reply.code == "NOT_READY"
        assert not isinstance(begun, Answer)
        kinds = [type(answered.reply) for answered in (first, *[await each for each in waiting], await begun)]
        assert kinds == [Queries] * 3 + [Actions]  # be they learned or not: the network takes as long as it takes
        assert counter.desk.due.n_refused == 1

    at_desk(test)


def test_who_has_waited_too_long_is_refused_and_who_waits_is_counted(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(8)
        assert [await counter.query(bots[:1]) for _ in range(2)] == [False, True]
        await asyncio.sleep(0)
        first, *waiting = (counter.put(counter.request([bot], 2000.0)) for bot in bots[:5])
        assert isinstance(first, Answer)
        full = counter.put(counter.request(bots[5:6]))
        assert isinstance(full, Answer)
        assert full.reply.code == "NOT_READY"
        counter.advance_us(5000.0)  # the machine stood still
        assert [(await each).reply.code for each in waiting] == ["NOT_READY"] * 4
        assert counter.desk.due.n_refused == 4
        assert len(counter.desk.looks) == 0
        await asyncio.sleep(0)
        assert await counter.query(bots[:1])

    at_desk(test)


def test_a_connection_ends_after_what_was_asked_for_on_it(at_desk: Callable[..., None]) -> None:
    async def test(counter: Counter) -> None:
        bots = await counter.start(1)
        assert [await counter.query(bots) for _ in range(2)] == [False, True]
        await asyncio.sleep(0)
        _, waiting = (counter.put(counter.request(bots)) for _ in range(2))
        counter.desk.end(str(counter.connection))
        assert (await waiting).reply.reasons is None
        await asyncio.sleep(0)
        answered = await asyncio.ensure_future(counter.put(counter.request(bots)))
        assert answered.reply.code == "NO_CONNECTION"

    at_desk(test)
