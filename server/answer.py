"""One request's bytes in, one reply's bytes out, whatever happens in between.

Every answered request passes here, with how and when it arrived. No exception leaves it and no traceback is ever sent.
"""

from __future__ import annotations

import logging
import time
from typing import NamedTuple, Self

from protocol import codec
from protocol.codec import Format
from protocol.errors import InternalError, ProtocolError
from protocol.messages import Error, Reply, Request
from server.handlers import Handlers

__all__ = ["Answer", "Arrival", "answer", "refusal"]

_log = logging.getLogger(__name__)


class Arrival(NamedTuple):
    """By which transport a request came (`http`, `tcp`, `unix`) and when it was whole: ns of the monotonic clock."""

    transport: str
    received_ns: int

    @classmethod
    def now(cls, transport: str) -> Self:
        """A request that has just been read to its end."""
        return cls(transport, time.monotonic_ns())


class Answer(NamedTuple):
    """A reply, the bytes to send, and the status where the door is HTTP."""

    reply: Reply
    body: bytes
    status: int


def answer(
    handlers: Handlers,
    sent: bytes | Request,
    form: Format,
    connection_id: str | None,
    arrival: Arrival,
    *,
    kind: type[Request] | None = None,
    reply_form: Format | None = None,
) -> Answer:
    """Decode, handle, encode. `sent` is the body, or the request where it is decoded already; `arrival` is how it came.

    `kind` is the message type where the door fixes it; `reply_form` is else `form`.
    """
    reply_form = reply_form or form
    try:
        if not isinstance(sent, bytes):
            request: Request = sent
        else:
            request = codec.decode_request(sent, form) if kind is None else codec.decode(sent, form, kind)
        reply = handlers.handle(request, connection_id, reply_form)
        return Answer(reply, codec.encode(reply, reply_form), 200)
    except ProtocolError as error:
        return refusal(error, reply_form)
    except Exception:
        _log.exception("a request failed")
        return refusal(InternalError("the server failed to answer; its log says why"), reply_form)


def refusal(error: ProtocolError, form: Format) -> Answer:
    """The answer that says why a request was refused."""
    reply = Error(code=error.code, detail=error.detail[: codec.MAX_DETAIL_CHARS], retry_after_s=error.retry_after_s)
    return Answer(reply, codec.encode(reply, form), error.status)
