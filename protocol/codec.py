"""Bytes to messages and back: the server's side, typed and bounded.

This module knows nothing about sockets, HTTP, bots or what the numbers in a message mean (`protocol.arrays` does).
Whatever bytes come in, nothing but a ProtocolError comes out. Clients do not use it:
`protocol.client` packs and unpacks on its own, so that two implementations meet in every test.
"""

from __future__ import annotations

from enum import Enum
from functools import cache
from typing import Any, TypeVar, cast

import msgspec

from protocol.errors import BadJson, BadMsgpack, BadSchema, ProtocolError, TooDeep
from protocol.features import FeatureTable
from protocol.messages import MAX_BOTS_PER_MESSAGE, Request

__all__ = [
    "LEAST_LIMIT_BYTES",
    "MAX_DETAIL_CHARS",
    "Format",
    "body_limit",
    "decode",
    "decode_request",
    "encode",
    "peek_deadline_us",
]

MAX_DETAIL_CHARS = 300
_HANDLE_BYTES = 21  # a 63-bit integer in JSON with its comma
_BIT_BYTES = 2  # `0,`
LEAST_LIMIT_BYTES = 16384  # names, brackets, the longest token with every character escaped
# A list of one number costs 100 bytes of memory and 4 of JSON. msgspec bounds lists before it makes them in msgpack, in
# JSON only afterwards; no message has more lists than this.
_MAX_JSON_LISTS = 4 * MAX_BOTS_PER_MESSAGE + 4096

Message = TypeVar("Message", bound=msgspec.Struct)
_Decoder = msgspec.msgpack.Decoder[Any] | msgspec.json.Decoder[Any]
_Encoder = msgspec.msgpack.Encoder | msgspec.json.Encoder


class Format(Enum):
    """How a message is written; the value is its HTTP content type."""

    MSGPACK = "application/msgpack"
    JSON = "application/json"
    __hash__ = object.__hash__  # of Enum's own, every look-up by format pays for a call


class _Peeked(msgspec.Struct):
    """One field of any message."""

    deadline_us: float | None = None


_NUMBER_BYTES = {Format.MSGPACK: 9, Format.JSON: 26}  # a double at its widest, with its comma in JSON


def body_limit(table: FeatureTable, max_bots: int, form: Format) -> int:
    """Bytes of the largest message that can make sense: `max_bots` bots of this table, in lists of the widest numbers.

    A bot has at most F + 4 numbers, D numbers and 2 M bits in a whole turn, and 5 numbers in a start.
    With no bots it is the largest hello. It is never less than `LEAST_LIMIT_BYTES`.
    """
    number_bytes = _NUMBER_BYTES[form]
    per_turn = number_bytes * (table.n_free + table.n_costly + 4) + 2 * _BIT_BYTES * table.n_queries
    per_bot = _HANDLE_BYTES + 16 + max(per_turn, 5 * number_bytes)
    return LEAST_LIMIT_BYTES + number_bytes * table.n_queries + per_bot * max_bots


def peek_deadline_us(body: bytes, form: Format) -> float | None:
    """The deadline that a message of any type names, without reading the rest of it; None where it cannot be told."""
    try:
        peeked: _Peeked = _decoder(form, _Peeked).decode(body)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None  # `decode` will say what is wrong with it
    return peeked.deadline_us


def decode(body: bytes, form: Format, message: type[Message]) -> Message:
    """One message of a known type; its `type` field may be left out.

    Raises BadMsgpack or BadJson (malformed, truncated, trailing bytes), TooDeep, BadSchema.
    """
    return cast("Message", _decode(body, form, _decoder(form, message)))


def decode_request(body: bytes, form: Format) -> Request:
    """One request of whichever type its `type` field names; raises as `decode` does."""
    request: Request = _decode(body, form, _REQUESTS[form])
    return request


def encode(message: msgspec.Struct, form: Format) -> bytes:
    """The bytes of one message. Its blobs must already be in this format (`protocol.arrays`)."""
    return _ENCODERS[form].encode(message)


@cache
def _decoder(form: Format, message: Any) -> _Decoder:
    return msgspec.msgpack.Decoder(message) if form is Format.MSGPACK else msgspec.json.Decoder(message)


_REQUESTS = {form: _decoder(form, Request) for form in Format}  # to hash a union takes longer than to decode
_ENCODERS: dict[Format, _Encoder] = {Format.MSGPACK: msgspec.msgpack.Encoder(), Format.JSON: msgspec.json.Encoder()}


def _decode(body: bytes, form: Format, decoder: _Decoder) -> Any:
    if form is Format.JSON and body.count(b"[") > _MAX_JSON_LISTS:
        raise _refusal(body, form, msgspec.ValidationError("more lists than any message has"))
    try:
        return decoder.decode(body)
    except RecursionError:
        raise TooDeep("the body is nested deeper than any message") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise _refusal(body, form, error) from None


def _refusal(body: bytes, form: Format, error: Exception) -> ProtocolError:
    """msgspec stops at the first fault it meets; a body that is broken further on is broken, not of a wrong schema."""
    malformed = BadMsgpack if form is Format.MSGPACK else BadJson
    try:
        _decoder(form, msgspec.Raw).decode(body)
    except RecursionError:
        return TooDeep("the body is nested deeper than any message")
    except msgspec.DecodeError as broken:
        return malformed(str(broken)[:MAX_DETAIL_CHARS])
    if isinstance(error, msgspec.ValidationError):
        return BadSchema(str(error)[:MAX_DETAIL_CHARS])
    return malformed(str(error)[:MAX_DETAIL_CHARS])
