"""Who is refused for want of time: by an injected clock, and what the others are told of it."""

from __future__ import annotations

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bot_runtime.deadline import LEAVE_US, Deadline
from protocol.messages import MAX_DEADLINE_US
from server.due import Due
from server.looks import Looks

TIMES_US = st.floats(0.0, 50_000.0)


def due_and_deadline(limit_us: float, passed_us: float) -> tuple[Due, Deadline]:
    return Due(Looks()), Deadline(0, limit_us, lambda: int(passed_us * 1e3))


@given(TIMES_US, TIMES_US, TIMES_US, TIMES_US)
def test_what_is_refused_had_no_time(limit_us: float, passed_us: float, wait_us: float, work_us: float) -> None:
    due, deadline = due_and_deadline(limit_us, passed_us)
    refused, left_us = due.refusal_of(deadline, wait_us, work_us), deadline.left_us()
    if refused is not None:
        assert left_us < wait_us + work_us
        assert refused.retry_after_s == max(wait_us, work_us) / 1e6
    elif wait_us:
        assert left_us >= wait_us + work_us
    assert due.n_refused == (refused is not None)


def test_a_deadline_that_no_waiting_explains_is_left_to_the_bots() -> None:
    due, deadline = due_and_deadline(1000.0 + LEAVE_US - 1.0, 0.0)
    assert due.refusal_of(deadline, 0.0, 1000.0) is None
    assert due.refusal_of(deadline, 1.0, 1000.0) is not None
    due, waited = due_and_deadline(2000.0, 1500.0)
    assert due.refusal_of(waited, 0.0, 1000.0) is not None


def test_what_is_new_needs_room_for_more_than_the_line() -> None:
    due, deadline = due_and_deadline(2000.0 + LEAVE_US, 0.0)
    assert due.refusal_of(deadline, 1000.0, 500.0, is_new=True) is None
    assert due.refusal_of(deadline, 1001.0, 500.0, is_new=True) is not None
    assert due.refusal_of(deadline, 1500.0, 500.0) is None
    assert due.refusal_of(deadline, 1501.0, 500.0) is not None


@pytest.mark.parametrize("limit_us", [-1.0, 2 * MAX_DEADLINE_US, float("nan")])
def test_what_is_no_deadline_is_left_to_the_handlers(limit_us: float) -> None:
    async def main() -> None:
        assert Due(Looks()).of(limit_us, 0) is None

    asyncio.run(main())
