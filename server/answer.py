"""One request's bytes in, one reply's bytes out, whatever happens in between.

Every answered request passes here, with how and when it arrived. No exception leaves it and no traceback is ever sent.
"""

from __future__ import annotations

import time
from typing import Self

from msgspec import Struct

from bot_runtime.deadline import Deadline
from bot_runtime.work import Steps, alone
from protocol import codec
from protocol.codec import Format
from protocol.errors import InternalError, ProtocolError
from protocol.messages import Error, Hello, Reply, Request, Welcome
from server.handlers import Handlers
from server.logs import digest, logger
from server.recorder import Spans

__all__ = ["Answer", "Arrival", "answer", "refusal", "steps"]

_log = logger(__name__)


class Arrival(Struct, frozen=True):  # made anew for every request: a tuple with names takes three times as long
    """By which transport a request came (`http`, `ws`, `tcp`, `unix`), when it was whole (ns of the monotonic clock)
    and by when it is to be answered, if that is said."""

    transport: str
    received_ns: int
    deadline: Deadline | None = None

    @classmethod
    def now(cls, transport: str) -> Self:
        """A request that has just been read to its end."""
        return cls(transport, time.monotonic_ns())


class Answer(Struct, frozen=True):
    """A reply, the bytes to send, and the status where the door is HTTP."""

    reply: Reply
    body: bytes
    status: int


def steps(
    handlers: Handlers,
    sent: bytes | Request,
    form: Format,
    connection_id: str | None,
    arrival: Arrival,
    *,
    kind: type[Request] | None = None,
    reply_form: Format | None = None,
    decoded_ns: int = 0,
) -> Steps[Answer]:
    """Decode, handle, encode. `sent` is the body, or the request where it is decoded already; `arrival` is how it came.

    `kind` is the message type where the door fixes it; `reply_form` is else `form`; `decoded_ns` is when the request
    was decoded, where it is.
    """
    reply_form, clock = reply_form or form, time.monotonic_ns
    started_ns = clock()
    try:
        if not isinstance(sent, bytes):
            request: Request = sent
            wait_ns, decode_ns = started_ns - decoded_ns, decoded_ns - arrival.received_ns
        else:
            request = codec.decode_request(sent, form) if kind is None else codec.decode(sent, form, kind)
            wait_ns, decode_ns = started_ns - arrival.received_ns, clock() - started_ns
        reply = yield from handlers.steps(request, connection_id, reply_form, arrival.deadline)
        handled_ns = clock()
        encoded = codec.encode(reply, reply_form)
        encoded_ns = clock()
        spans = Spans(wait_ns, decode_ns, encoded_ns - handled_ns, encoded_ns - arrival.received_ns)
        handlers.recorder.answered(arrival.transport, request, reply, spans)
        if isinstance(reply, Welcome):
            opened = digest(reply.connection)
            _log.info("connection opened", transport=arrival.transport, connection=opened, bundle=reply.bundle)
        return Answer(reply, encoded, 200)
    except ProtocolError as error:
        refused = error
    except Exception:
        _log.exception("a request failed")
        refused = InternalError("the server failed to answer; its log says why")
    handlers.recorder.refused(arrival.transport, refused.code)
    if kind is Hello or isinstance(sent, Hello):
        _log.warning("hello refused", transport=arrival.transport, code=refused.code)
    return refusal(refused, reply_form)


answer = alone(steps)


def refusal(error: ProtocolError, form: Format) -> Answer:
    """The answer that says why a request was refused."""
    reply = Error(code=error.code, detail=error.detail[: codec.MAX_DETAIL_CHARS], retry_after_s=error.retry_after_s)
    return Answer(reply, codec.encode(reply, form), error.status)
