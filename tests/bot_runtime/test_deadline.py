"""A deadline: who answers, and how much of it is left."""

from __future__ import annotations

import threading
from collections.abc import Callable

from bot_runtime.deadline import LEAVE_US, Deadline
from tests.bot_runtime.test_durations import Clock
from tests.bot_runtime.world import ROOM_US


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
