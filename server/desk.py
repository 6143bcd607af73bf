"""Where a request is answered: on the event loop if that is known to be quick, else by the worker.

This module knows nothing about sockets, or about what an answer says. A hop to the worker's thread and back costs more
than a turn of a few bots, so those stay here; what is large, rare or not yet known goes there.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial

from bot_runtime.work import finished
from protocol import codec
from protocol.codec import Format
from protocol.errors import NotReady, ProtocolError
from protocol.messages import Actions, Queries, Request, RequestQueries, SubmitFeatures, TakeTurn
from server.answer import Answer, Arrival, refusal, steps
from server.asked import Asked, companions
from server.connections import Connection
from server.due import Due
from server.handlers import Handlers
from server.looks import Looks
from server.pace import Pace
from server.serving import Serving
from server.worker import Worker

__all__ = ["Desk"]

_MAX_INLINE_BYTES = 16384  # decoding so much takes less than a turn
_TURNS = RequestQueries, SubmitFeatures, TakeTurn

Answered = Answer | asyncio.Future[Answer]


class Desk:
    """Answers requests of every door in the order in which they come, one at a time.

    A turn is answered on the event loop if the worker is idle and turns like it, of the same bundle, take at most
    `inline_us`: before `ask` returns, or in the line of `looks`, which gives one a turn between two looks at the
    sockets. So that is how long requests hold up the event loop: one that is larger, or of a size that was not met
    before, never does. `default_deadline_us` is that of a turn which names none. `clock` counts ns; so does
    `worker_clock`, but only while its thread runs: the worker also waits for the interpreter, which the event loop
    would not.

    Turns that wait in the line are inferred with the first of them, those of up to `batch_connections` connections.
    """

    def __init__(
        self,
        handlers: Handlers,
        worker: Worker,
        *,
        inline_us: float,
        batch_connections: int = 1,
        default_deadline_us: float | None = None,
        looks: Looks | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        worker_clock: Callable[[], int] = time.thread_time_ns,
    ) -> None:
        self.handlers = handlers
        self.looks = Looks(clock, handlers.recorder.settle) if looks is None else looks
        self.due = Due(self.looks, default_us=default_deadline_us, clock=clock)
        self._worker = worker
        self._inline_us = inline_us
        self._most = batch_connections
        self._line: dict[asyncio.Future[Answer], Asked] = {}  # what `looks` has the jobs of
        self._strangers = Pace()
        self._clock = clock
        self._worker_clock = worker_clock
        self._ended_ns = 0  # when the worker last ended a request: its thread alone looks at this

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
        reply_form, connection = reply_form or form, self.handlers.connections.heard(connection_id)
        pace = self._strangers if connection is None else connection.serving.pace
        if len(body) > _MAX_INLINE_BYTES:
            arrival = self._due_by(arrival, codec.peek_deadline_us(body, form), connection)
            job = partial(steps, self.handlers, body, form, connection_id, arrival, kind=kind, reply_form=reply_form)
            return self._in_turn(
                Asked(job, arrival, reply_form, connection_id, pace, bytes, len(body), None, connection)
            )
        try:
            request = codec.decode_request(body, form) if kind is None else codec.decode(body, form, kind)
        except ProtocolError:  # answered by refusing it, bots untouched
            return finished(steps(self.handlers, body, form, connection_id, arrival, kind=kind, reply_form=reply_form))
        decoded_ns, size, turn = time.monotonic_ns(), 0, None
        if isinstance(request, _TURNS):
            arrival = self._due_by(arrival, request.deadline_us, connection)
            size = len(request.bots)
            turn = type(request), size.bit_length()
        how = partial(steps, self.handlers, request, form, connection_id, arrival)
        begun = partial(how, reply_form=reply_form, decoded_ns=decoded_ns)
        kind = type(request)
        return self._in_turn(Asked(begun, arrival, reply_form, connection_id, pace, kind, size, turn, connection))

    def end(self, connection_id: str) -> None:
        """End a connection whose socket has closed, after what was asked for on it."""
        job = partial(self._worker.post, partial(self.handlers.end, connection_id))
        if len(self.looks):
            self.looks.put(job, 0.0)
        else:
            job()

    def _due_by(self, arrival: Arrival, deadline_us: float | None, connection: Connection | None) -> Arrival:
        answered_ns = 0 if connection is None else connection.answered_ns
        deadline = self.due.of(deadline_us, arrival.received_ns, answered_ns)
        return arrival if deadline is None else Arrival(arrival.transport, arrival.received_ns, deadline)

    def _in_turn(self, asked: Asked) -> Answered:
        """Refuse at once, begin at once or, behind others and where this look has had its turn, in the line."""
        # Where nothing waits nobody gains by a refusal: then the bots fall back.
        if not (self.looks.is_free and self._worker.is_idle):
            refused = self._refused(asked, self.looks.backlog_us, is_new=asked.kind is not SubmitFeatures)
            if refused is not None:
                return refused
        if self.looks.is_free or (len(self.looks) == 0 and not self._is_quick(asked)):
            return self._begin(asked)
        if len(self.looks) + self._worker.n_waiting >= self._worker.max_queue:
            return self._refuse(asked, NotReady("too many requests are waiting already", retry_after_s=0.1))
        outcome: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._line[outcome] = asked
        self.looks.put(partial(self._begin_for, outcome, asked), asked.work_us)
        return outcome

    def _begin_for(self, outcome: asyncio.Future[Answer], asked: Asked) -> None:
        """Its turn has come, after waiting."""
        if self._line.pop(outcome, None) is None:
            return  # it was answered together with another
        others = companions(asked, self._line, self._most, self._is_quick)
        if others and asked.serving is not None:
            self._answer_together(asked.serving, [(outcome, asked), *others])
            return
        refused = self._refused(asked)
        answered = self._begin(asked) if refused is None else refused
        if isinstance(answered, Answer):
            _settle(outcome, answered)
        else:
            answered.add_done_callback(lambda done: _settle(outcome, done.result()))

    def _answer_together(self, serving: Serving, group: list[tuple[asyncio.Future[Answer], Asked]]) -> None:
        """On the event loop; what there is no time for is refused."""
        begun = []
        for outcome, asked in group:
            self._line.pop(outcome, None)
            refused = self._refused(asked)
            if refused is None:
                begun.append((outcome, asked))
            else:
                _settle(outcome, refused)
        if not begun:
            return
        self.looks.take()
        begun_ns = self._clock()
        answers = serving.bots.together.finished([asked.steps() for _, asked in begun])
        took_us = (self._clock() - begun_ns) / 1e3
        for (outcome, asked), answered in zip(begun, answers, strict=True):
            _settle(outcome, self._sealed(asked, answered, took_us / len(begun)))

    def _begin(self, asked: Asked) -> Answered:
        """Answer here, or have the worker do it by its deadline."""
        if self._is_quick(asked):
            return self._answered_here(asked)
        try:
            answered = self._worker.run(partial(self._answered_there, asked, self._clock()), asked.work_us)
        except NotReady as error:
            return self._refuse(asked, error)
        deadline = asked.arrival.deadline
        return answered if deadline is None else self.due.watched(deadline, answered, asked.form)

    def _is_quick(self, asked: Asked) -> bool:
        return asked.turn is not None and self._worker.is_idle and asked.pace.expected_us(asked.turn) <= self._inline_us

    def _answered_here(self, asked: Asked) -> Answer:
        """On the event loop."""
        self.looks.take()
        begun_ns = self._clock()
        answered = finished(asked.steps())
        return self._sealed(asked, answered, (self._clock() - begun_ns) / 1e3)

    def _sealed(self, asked: Asked, answered: Answer, took_us: float) -> Answer:
        """An answer of the event loop as it leaves, and what is learned of how long it took."""
        deadline = asked.arrival.deadline
        if asked.turn is not None:
            asked.pace.observe(asked.turn, took_us)
        self._answered(asked)
        if deadline is None:
            return answered
        _note(asked, answered, took_us)
        return self.due.kept(deadline, answered, asked.form)

    def _answered(self, asked: Asked) -> None:
        """What this connection asks next it asks from now on."""
        if asked.connection is not None:
            asked.connection.answered_ns = self._clock()

    def _answered_there(self, asked: Asked, put_ns: int) -> Answer:
        """On the worker's thread. The whole of it is from the last one's end, or from when it was put there."""
        begun_ns, worker_ns = max(put_ns, self._ended_ns), self._worker_clock()
        answered = finished(asked.steps())
        if asked.turn is not None:
            asked.pace.observe(asked.turn, (self._worker_clock() - worker_ns) / 1e3)
        self._ended_ns = self._clock()
        self._answered(asked)
        _note(asked, answered, (self._ended_ns - begun_ns) / 1e3)
        return answered

    def _refused(self, asked: Asked, line_us: float = 0.0, *, is_new: bool = False) -> Answer | None:
        """The refusal of what would wait in the line for so long, and then for the worker, for longer than it may."""
        deadline = asked.arrival.deadline
        if deadline is None:
            return None
        error = self.due.refusal_of(deadline, line_us + self._worker.backlog_us, asked.work_us, is_new=is_new)
        return None if error is None else self._refuse(asked, error)

    def _refuse(self, asked: Asked, error: NotReady) -> Answer:
        self.handlers.recorder.refused(asked.arrival.transport, error.code)
        self._answered(asked)
        return refusal(error, asked.form)


def _note(asked: Asked, answered: Answer, took_us: float) -> None:
    """How long work took as a whole that has just ended, if the network was run."""
    if isinstance(answered.reply, Queries | Actions) and answered.reply.infer_us > 0.0:  # not shed, not refused
        asked.pace.observe_whole(asked.kind, asked.size, took_us)


def _settle(outcome: asyncio.Future[Answer], answered: Answer) -> None:
    if not outcome.done():  # else nobody waits any more: the client went away
        outcome.set_result(answered)
