"""Who is refused for want of time: by an injected clock, and what the others are told of it."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bot_runtime.deadline import LEAVE_US, Deadline
from protocol.codec import Format
from protocol.messages import MAX_DEADLINE_US
from server.due import Due
from server.looks import Looks

TIMES_US = st.floats(0.0, 50_000.0)


def due_and_deadline(limit_us: float, passed_us: float) -> tuple[Due, Deadline]:
    return Due(Looks()), Deadline(0, limit_us, lambda: int(passed_us * 1e3))


@given(TIMES_US, TIMES_US, TIMES_US, TIMES_US)
def test_what_is_refused_had_no_time_and_what_was_begun_has_more_of_it_than_what_is_new(
    limit_us: float, passed_us: float, wait_us: float, work_us: float
) -> None:
    due, deadline = due_and_deadline(limit_us, passed_us)
    new, begun = (due.refusal_of(deadline, wait_us, work_us, Format.MSGPACK, is_new=is_new) for is_new in (True, False))
    left_us = deadline.left_us()
    if begun is not None:
        assert new is not None
        assert left_us < wait_us + work_us
    if new is not None:
        assert left_us < 2.0 * wait_us + work_us
        assert new.reply.retry_after_s >= work_us / 1e6
    elif wait_us:
        assert left_us >= 2.0 * wait_us + work_us
    assert due.n_refused == (new is not None) + (begun is not None)


def test_a_deadline_that_no_waiting_explains_is_left_to_the_bots() -> None:
    due, deadline = due_and_deadline(1000.0 + LEAVE_US - 1.0, 0.0)
    assert due.refusal_of(deadline, 0.0, 1000.0, Format.MSGPACK, is_new=True) is None
    assert due.refusal_of(deadline, 1.0, 1000.0, Format.MSGPACK, is_new=True) is not None
    due, waited = due_and_deadline(2000.0, 1500.0)
    assert due.refusal_of(waited, 0.0, 1000.0, Format.MSGPACK, is_new=False) is not None


@pytest.mark.parametrize("limit_us", [-1.0, 2 * MAX_DEADLINE_US, float("nan")])
def test_what_is_no_deadline_is_left_to_the_handlers(limit_us: float) -> None:
    async def main() -> None:
        assert Due(Looks()).of(limit_us, 0) is None

    asyncio.run(main())
