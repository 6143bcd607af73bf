"""Deadlines at the desk: who is refused because there is no time, who is answered when it is up, and who is told late.

This module knows nothing about bots or sockets. It runs on the event loop's thread.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from msgspec.structs import replace

from bot_runtime.deadline import LEAVE_US, Deadline
from protocol import codec
from protocol.codec import Format
from protocol.errors import NotReady
from protocol.messages import MAX_DEADLINE_US, Actions, Queries
from server.answer import Answer, refusal
from server.looks import Looks
from server.written import written

__all__ = ["Due"]

# What waits before new work may take two thirds of what its deadline leaves: a machine that becomes half as slow again
# then keeps it. That costs nothing where there always is a line. A turn that was half answered is worth more.
_NEW_SHARE = 1.5
_TICK_US = 1000.0  # the event loop's timers count whole ms, and may be early by one


class Due:
    """Deadlines of requests that are found at these looks. `default_us` is that of a request that names none.

    `clock` counts ns and is monotonic. Counters only grow: `n_refused` for want of time, `n_timed_out` answered by the
    event loop while the work went on, `n_late` that left late.
    """

    def __init__(
        self, looks: Looks, *, default_us: float | None = None, clock: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._looks = looks
        self._default_us = default_us
        self._clock = clock
        self.n_refused = self.n_timed_out = self.n_late = 0

    def of(self, asked_us: float | None, received_ns: int, answered_ns: int = 0) -> Deadline | None:
        """The deadline of a request, if it has any; one that is not legal is refused by the handlers.

        It came after `answered_ns`, when its connection was answered before.
        """
        limit_us = self._default_us if asked_us is None else asked_us
        if limit_us is None or not 0.0 <= limit_us <= MAX_DEADLINE_US:
            return None
        return Deadline(max(self._looks.since_ns(received_ns), answered_ns), limit_us, self._clock)

    def refusal_of(
        self, deadline: Deadline, wait_us: float, work_us: float, *, is_new: bool = False
    ) -> NotReady | None:
        """Why a request is refused, if there is not enough time for it.

        That is quicker than to let its bots fall back, which would cost those that can still be served their time. A
        deadline that would not do without any waiting either is no reason: then the bots fall back.
        """
        left_us, share = deadline.left_us(), _NEW_SHARE if is_new else 1.0
        if left_us >= share * wait_us + work_us or (wait_us == 0.0 and deadline.limit_us < work_us + LEAVE_US):
            return None
        self.n_refused += 1
        busy = f"the deadline leaves {left_us:.0f} us, for {wait_us:.0f} of waiting and {work_us:.0f} of work"
        return NotReady(busy, retry_after_s=max(wait_us, work_us) / 1e6)

    def kept(self, deadline: Deadline, answered: Answer, form: Format) -> Answer:
        """The answer as it leaves now: one that is late says so."""
        reply = answered.reply
        if not deadline.is_over or not isinstance(reply, Queries | Actions):
            return answered
        self.n_late += 1
        reply = replace(reply, late=True)
        return Answer(reply, codec.encode(reply, form), answered.status)

    def watched(self, deadline: Deadline, working: asyncio.Future[Answer], form: Format) -> asyncio.Future[Answer]:
        """What the work answers or, when that takes too long, what was offered instead."""
        loop = working.get_loop()
        answered: asyncio.Future[Answer] = loop.create_future()
        left_us = deadline.left_us()
        # Less than a tick is not worth a timer: the worker itself falls back when it is too late.
        timer = loop.call_later(left_us // _TICK_US / 1e3, self._expire, deadline, answered, form)
        if left_us < _TICK_US:
            timer.cancel()

        def finish(done: asyncio.Future[Answer]) -> None:
            timer.cancel()
            if not answered.done():
                answered.set_result(self.kept(deadline, done.result(), form))

        working.add_done_callback(finish)
        return answered

    def _expire(self, deadline: Deadline, answered: asyncio.Future[Answer], form: Format) -> None:
        if answered.done() or not deadline.expire():
            return
        if deadline.fallback is None:
            self.n_refused += 1
            unbegun = NotReady("the deadline passed before the request was begun", retry_after_s=0.1)
            answered.set_result(refusal(unbegun, form))
            return
        self.n_timed_out += 1
        reply = written(deadline.fallback, form)
        answered.set_result(self.kept(deadline, Answer(reply, codec.encode(reply, form), 200), form))
