"""Where a request is answered: on the event loop if that is known to be quick, else by the worker.

This module knows nothing about sockets, or about what an answer says. A hop to the worker's thread and back costs more
than a turn of a few bots, so those stay here; what is large, rare or not yet known goes there.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from protocol import codec
from protocol.codec import Format
from protocol.errors import NotReady, ProtocolError
from protocol.messages import Actions, Queries, Request, RequestQueries, SubmitFeatures, TakeTurn
from server.answer import Answer, Arrival, answer, refusal
from server.due import Due
from server.handlers import Handlers
from server.pace import Kind, Pace
from server.worker import Worker

__all__ = ["Desk"]

_MAX_INLINE_BYTES = 16384  # decoding so much takes less than a turn
_TURNS = RequestQueries, SubmitFeatures, TakeTurn

Answered = Answer | asyncio.Future[Answer]


class Desk:
    """Answers requests of every door in the order in which they come, one at a time.

    A turn is answered before `ask` returns if the worker is idle and turns like it, of the same bundle, take at most
    `inline_us`. That is how long one client's request may hold up the event loop: one that is larger, or of a size that
    was not met before, never does. `clock` counts ns; so does `worker_clock`, but only while its thread runs: the
    worker also waits for the interpreter, which the event loop would not.
    """

    def __init__(
        self,
        handlers: Handlers,
        worker: Worker,
        *,
        inline_us: float,
        due: Due | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        worker_clock: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self.handlers = handlers
        self.due = due or Due(worker)
        self._worker = worker
        self._inline_us = inline_us
        self._clock = clock
        self._worker_clock = worker_clock

    def ask(
        self,
        body: bytes,
        form: Format,
        connection_id: str | None,
        arrival: Arrival,
        *,
        kind: type[Request] | None = None,
        reply_form: Format | None = None,
    ) -> Answered:
        """The answer, or the future of it. Arguments are those of `server.answer.answer`."""
        reply_form = reply_form or form
        if len(body) > _MAX_INLINE_BYTES:
            arrival = self._due_by(arrival, codec.peek_deadline_us(body, form))
            job = partial(answer, self.handlers, body, form, connection_id, arrival, kind=kind, reply_form=reply_form)
            return self._in_time(job, arrival, (bytes, len(body)), reply_form)
        try:
            request = codec.decode_request(body, form) if kind is None else codec.decode(body, form, kind)
        except ProtocolError:  # answered by refusing it, bots untouched
            return answer(self.handlers, body, form, connection_id, arrival, kind=kind, reply_form=reply_form)
        how: dict[str, Any] = {"reply_form": reply_form, "decoded_ns": time.monotonic_ns()}
        if not isinstance(request, _TURNS):
            return self._hop(
                partial(answer, self.handlers, request, form, connection_id, arrival, **how), arrival, reply_form
            )
        arrival = self._due_by(arrival, request.deadline_us)
        turn = type(request), len(request.bots).bit_length()
        work = type(request), len(request.bots)
        pace = self.handlers.pace_of(connection_id)
        if self._worker.is_idle and pace.expected_us(turn) <= self._inline_us:
            refused = self._refused(arrival, work, reply_form)
            if refused is not None:
                return refused
            begun_ns = self._clock()
            answered = answer(self.handlers, request, form, connection_id, arrival, **how)
            pace.observe(turn, (self._clock() - begun_ns) / 1e3)
            if arrival.deadline is None:
                return answered
            self._note(work, answered, how["decoded_ns"])
            return self.due.kept(arrival.deadline, answered, reply_form)
        job = partial(answer, self.handlers, request, form, connection_id, arrival, **how)
        return self._in_time(partial(self._timed, pace, turn, job), arrival, work, reply_form)

    def end(self, connection_id: str) -> None:
        """End a connection whose socket has closed, after what was asked for on it."""
        self._worker.post(partial(self.handlers.end, connection_id))

    def _due_by(self, arrival: Arrival, deadline_us: float | None) -> Arrival:
        deadline = self.due.of(deadline_us, arrival.received_ns)
        return arrival if deadline is None else Arrival(arrival.transport, arrival.received_ns, deadline)

    def _in_time(
        self, job: Callable[[], Answer], arrival: Arrival, work: tuple[type[object], int], form: Format
    ) -> Answered:
        """Have the worker do work of this kind and size by its deadline, or refuse it where that cannot be."""
        refused = self._refused(arrival, work, form)
        if refused is not None:
            return refused
        answered = self._hop(partial(self._measured, work, job), arrival, form, self.due.expected_us(*work))
        if arrival.deadline is None or isinstance(answered, Answer):
            return answered
        return self.due.watched(arrival.deadline, answered, form)

    def _refused(self, arrival: Arrival, work: tuple[type[object], int], form: Format) -> Answer | None:
        if arrival.deadline is None:
            return None
        refused = self.due.refusal_of(arrival.deadline, self.due.expected_us(*work), form)
        if refused is not None:
            self.handlers.recorder.refused(arrival.transport, NotReady.code)
        return refused

    def _measured(self, work: tuple[type[object], int], job: Callable[[], Answer]) -> Answer:
        begun_ns = time.monotonic_ns()
        answered = job()
        self._note(work, answered, begun_ns)
        return answered

    def _note(self, work: tuple[type[object], int], answered: Answer, begun_ns: int) -> None:
        """How long work took that has just ended, if the network was run."""
        if isinstance(answered.reply, Queries | Actions) and answered.reply.infer_us > 0.0:  # not shed, not refused
            self.due.observe(*work, (time.monotonic_ns() - begun_ns) / 1e3)

    def _hop(self, job: Callable[[], Answer], arrival: Arrival, form: Format, expected_us: float = 0.0) -> Answered:
        try:
            return self._worker.run(job, expected_us)
        except NotReady as error:
            self.handlers.recorder.refused(arrival.transport, error.code)
            return refusal(error, form)

    def _timed(self, pace: Pace, turn: Kind, job: Callable[[], Answer]) -> Answer:
        begun_ns = self._worker_clock()
        answered = job()
        pace.observe(turn, (self._worker_clock() - begun_ns) / 1e3)
        return answered
