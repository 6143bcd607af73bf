"""The line between two looks at the sockets, and since when what was read may have been there: by an injected clock."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial

from server.looks import Looks

MS = 1_000_000


class Clock:
    def __init__(self) -> None:
        self.ns = 10**12

    def __call__(self) -> int:
        return self.ns


def run(test: Callable[[Looks, Clock], object]) -> None:
    async def main() -> None:
        clock = Clock()
        await test(Looks(clock), clock)

    asyncio.run(main())


def test_one_job_has_its_turn_between_two_looks_in_the_order_of_the_line() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        done: list[int] = []

        def job(number: int) -> None:
            looks.take()
            done.append(number)

        assert looks.is_free
        job(0)
        assert not looks.is_free
        for number in (1, 2, 3):
            looks.put(lambda number=number: job(number), 100.0)
        assert (len(looks), looks.backlog_us) == (3, 300.0)
        for look in (1, 2, 3):
            await asyncio.sleep(0)
            assert done == list(range(look + 1))
            assert (len(looks), looks.backlog_us) == (3 - look, 300.0 - 100.0 * look)
            assert not looks.is_free
        await asyncio.sleep(0)
        assert looks.is_free
        assert done == [0, 1, 2, 3]

    run(test)


def test_who_leaves_its_turn_leaves_it_to_the_next() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        done: list[str] = []
        looks.put(lambda: done.append("refused"), 0.1)
        looks.put(lambda: done.append("to the worker"), 0.2)
        looks.put(lambda: (looks.take(), done.append("answered")), 0.3)
        looks.put(lambda: done.append("later"), 0.4)
        await asyncio.sleep(0)
        assert done == ["refused", "to the worker", "answered"]
        await asyncio.sleep(0)
        assert done[-1] == "later"
        assert (len(looks), looks.backlog_us) == (0, 0.0)  # whatever floats have lost on the way

    run(test)


def test_what_can_wait_is_done_when_nothing_else_waits() -> None:
    async def main() -> None:
        done: list[str] = []
        looks, loop = Looks(afterwards=lambda: done.append("afterwards")), asyncio.get_running_loop()

        def job(name: str) -> None:
            looks.take()
            done.append(name)
            outcome: asyncio.Future[None] = loop.create_future()
            outcome.add_done_callback(lambda _: done.append(f"{name} has left"))
            outcome.set_result(None)

        job("at once")
        for name in ("first", "second"):
            looks.put(partial(job, name), 1.0)
        for _ in range(6):
            await asyncio.sleep(0)
        names = [f"{name}{left}" for name in ("at once", "first", "second") for left in ("", " has left")]
        assert sorted(done[:-1]) == sorted(names)
        assert done[-1] == "afterwards"

    asyncio.run(main())


def test_after_sleep_what_is_read_has_just_come() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        first_ns = clock.ns
        assert looks.since_ns(first_ns) == first_ns
        clock.ns += 5 * MS
        assert looks.since_ns(clock.ns) == first_ns  # in the same look: it came before the first was read
        await asyncio.sleep(0)
        clock.ns += 5 * MS  # asleep
        assert looks.since_ns(clock.ns) == clock.ns

    run(test)


def test_what_comes_while_others_are_served_counts_from_the_look_before() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        def job() -> None:
            looks.take()
            clock.ns += 3 * MS

        before_ns = clock.ns
        looks.since_ns(before_ns)
        job()
        looks.put(job, 3000.0)
        await asyncio.sleep(0)  # the one that waited has its turn, and then there is another look
        clock.ns += MS // 10
        second_ns = clock.ns
        assert looks.since_ns(second_ns) == before_ns
        await asyncio.sleep(0)
        clock.ns += MS // 10
        assert looks.since_ns(clock.ns) == second_ns

    run(test)


def test_a_look_that_found_nothing_counts_as_one() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        looks.since_ns(clock.ns)
        for _ in range(2):
            looks.put(looks.take, 0.0)
        clock.ns += MS
        await asyncio.sleep(0)
        ended_ns = clock.ns
        clock.ns += MS
        await asyncio.sleep(0)  # nothing was read since the last one ended
        assert looks.since_ns(clock.ns + 1) == ended_ns

    run(test)


def test_a_look_without_deadlines_after_a_sleep_counts_from_itself() -> None:
    async def test(looks: Looks, clock: Clock) -> None:
        clock.ns += 3_600_000 * MS  # nothing for an hour
        slept_ns = clock.ns
        looks.take()
        await asyncio.sleep(0)
        clock.ns += MS // 10
        assert looks.since_ns(clock.ns) == slept_ns

    run(test)
