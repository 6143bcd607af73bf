"""One request's bytes in, one reply's bytes out, whatever happens in between.

This module knows nothing about which transport the bytes came by. No exception leaves it and no traceback is ever sent.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

from protocol import codec
from protocol.codec import Format
from protocol.errors import InternalError, ProtocolError
from protocol.messages import Error, Reply, Request
from server.handlers import Handlers

__all__ = ["Answer", "answer", "refusal"]

_log = logging.getLogger(__name__)


class Answer(NamedTuple):
    """A reply, the bytes to send, and the status where the door is HTTP."""

    reply: Reply
    body: bytes
    status: int


def answer(
    handlers: Handlers,
    body: bytes,
    form: Format,
    connection_id: str | None,
    *,
    kind: type[Request] | None = None,
    reply_form: Format | None = None,
) -> Answer:
    """Decode, handle, encode. `kind` is the message type where the door fixes it; `reply_form` is else `form`."""
    reply_form = reply_form or form
    try:
        request = codec.decode_request(body, form) if kind is None else codec.decode(body, form, kind)
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
