from __future__ import annotations

import json
import tracemalloc
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import codec
from protocol.codec import Format
from protocol.errors import BadJson, BadMsgpack, BadSchema, ProtocolError, TooDeep
from protocol.messages import MAX_FRAME, Error, StopBots
from tests.protocol.golden import REQUESTS, TABLE, Vector

DOCUMENTED = {"BAD_MSGPACK", "BAD_JSON", "TOO_DEEP", "BAD_SCHEMA"}


def _refusal(body: bytes, form: Format) -> ProtocolError | None:
    try:
        codec.decode_request(body, form)
    except ProtocolError as refusal:
        return refusal
    return None


@pytest.mark.parametrize("vector", REQUESTS, ids=lambda vector: vector.name)
def test_a_body_cut_anywhere_is_malformed(vector: Vector) -> None:
    written = json.dumps(vector.message).encode()
    for form, body, refusal in ((Format.MSGPACK, vector.body, BadMsgpack), (Format.JSON, written, BadJson)):
        for cut in range(len(body)):
            with pytest.raises(refusal):
                codec.decode_request(body[:cut], form)
        with pytest.raises(refusal):
            codec.decode_request(body + body, form)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=200), st.sampled_from(Format))
def test_any_bytes_yield_a_message_or_a_documented_error(body: bytes, form: Format) -> None:
    refusal = _refusal(body, form)
    assert refusal is None or refusal.code in DOCUMENTED
    assert refusal is None or len(refusal.detail) <= codec.MAX_DETAIL_CHARS


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_message_with_changed_bytes_yields_a_message_or_a_documented_error(data: st.DataObject) -> None:
    body = bytearray(data.draw(st.sampled_from(REQUESTS)).body)
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    refusal = _refusal(bytes(body), Format.MSGPACK)
    assert refusal is None or refusal.code in DOCUMENTED


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None)
@given(plain, st.sampled_from(["count", "seeds", "budgets_us", "type", "colour"]))
def test_well_formed_values_of_the_wrong_kind_are_a_bad_schema(value: Any, field: str) -> None:
    body = msgpack.packb({"type": "start_bots", "count": 1, field: value})
    refusal = _refusal(body, Format.MSGPACK)
    assert refusal is None or isinstance(refusal, BadSchema)
    assert refusal is not None or field not in ("type", "colour")


@pytest.mark.parametrize("place", [b"", b"\x81\xa4type", b"\x81\xa4free", b"\x82\xa4type\xaastart_bots\xa5count"])
@pytest.mark.parametrize("nest", [b"\x91", b"\x81\xa1a", b"\x81"])
def test_nesting_bombs_are_too_deep_wherever_they_lie(place: bytes, nest: bytes) -> None:
    with pytest.raises(TooDeep):
        codec.decode_request(place + nest * 20000, Format.MSGPACK)


@pytest.mark.parametrize("body", [b"[" * 20000, b'{"free":' * 20000, b'{"type":"start_bots","count":' + b"[" * 20000])
def test_json_nesting_bombs_are_too_deep(body: bytes) -> None:
    with pytest.raises(TooDeep):
        codec.decode_request(body, Format.JSON)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_json_has_no_numbers_that_json_does_not_have(number: str) -> None:
    body = f'{{"type":"request_queries","frame":0,"bots":[1],"free":[[{number}]]}}'
    with pytest.raises(BadJson):
        codec.decode_request(body.encode(), Format.JSON)


@pytest.mark.parametrize(
    "message",
    [
        {"type": "stop_bots", "bots": []},
        {"type": "stop_bots", "bots": [-1]},
        {"type": "stop_bots", "bots": [2**63]},
        {"type": "stop_bots", "bots": [1.5]},
        {"type": "stop_bots", "bots": ["1"]},
        {"type": "start_bots", "count": 0},
        {"type": "start_bots", "count": 65537},
        {"type": "start_bots", "count": 1, "seeds": [-1]},
        {"type": "request_queries", "frame": MAX_FRAME + 1, "bots": [1], "free": b""},
        {"type": "submit_features", "frame": 1, "bots": [1], "acquired": [[2]], "values": b""},
        {"type": "hello", "token": "x" * 1025},
        {"type": "hello", "cost_model": {"call_us": -1.0, "feature_us": []}},
        {"type": "hello", "cost_model": {"call_us": float("nan"), "feature_us": []}},
        {"type": "welcome"},
        {"type": "error", "code": "X", "detail": ""},
        {},
        [],
        None,
    ],
)
def test_fields_are_bounded_and_replies_are_no_requests(message: Any) -> None:
    with pytest.raises(BadSchema):
        codec.decode_request(msgpack.packb(message), Format.MSGPACK)


def test_a_known_type_need_not_be_named_but_must_not_be_another() -> None:
    assert codec.decode(b'{"bots":[1]}', Format.JSON, StopBots) == StopBots(bots=[1])
    with pytest.raises(BadSchema):
        codec.decode(b'{"type":"start_bots","bots":[1]}', Format.JSON, StopBots)


def test_json_replies_are_json() -> None:
    assert json.loads(codec.encode(Error("NO_BOT", "é"), Format.JSON)) == {
        "type": "error",
        "code": "NO_BOT",
        "detail": "é",
        "retry_after_s": None,
    }


@pytest.mark.parametrize("max_bots", [1, 3, 256])
def test_the_widest_messages_fit_the_limit(max_bots: int) -> None:
    wide, handle = -1.2345678901234567e-300, 2**63 - 1
    bots = [handle] * max_bots
    messages = [
        {
            "bots": bots,
            "frame": MAX_FRAME,
            "free": [[wide] * TABLE.n_free] * max_bots,
            "frame_budget_us": wide,
            **{name: [wide] * max_bots for name in ("rewards", "budgets_us", "target_costs_us")},
        },
        {
            "bots": bots,
            "frame": MAX_FRAME,
            "acquired": [[1] * TABLE.n_queries] * max_bots,
            "values": [[wide] * TABLE.n_costly] * max_bots,
            "failed": [[0] * TABLE.n_queries] * max_bots,
        },
        {
            "count": max_bots,
            "seeds": bots,
            **{name: [wide] * max_bots for name in ("target_returns", "budgets_us", "target_costs_us")},
        },
        {"token": "\x01" * 1024, "cost_model": {"call_us": wide, "feature_us": [wide] * TABLE.n_queries}},
    ]
    for message in messages:
        assert len(msgspec.json.encode(message)) + 64 <= codec.body_limit(TABLE, max_bots, Format.JSON)
        assert len(msgpack.packb(message)) + 64 <= codec.body_limit(TABLE, max_bots, Format.MSGPACK)
    hello = {"type": "hello", **messages[-1], "token": "\U0001f916" * 1024, "bundle": "b" * 74}
    assert len(json.dumps(hello)) + 64 <= codec.body_limit(TABLE, 0, Format.JSON)  # 12 characters for each of them
    assert len(msgpack.packb(hello)) + 64 <= codec.body_limit(TABLE, 0, Format.MSGPACK)


@pytest.mark.parametrize("form", list(Format))
@pytest.mark.parametrize("row", [[], [1]])
@pytest.mark.parametrize("field", ["acquired", "values"])
def test_rows_without_number_are_refused_before_they_take_memory(form: Format, row: list[int], field: str) -> None:
    """A list takes some 100 bytes, its bytes on the wire are one to four."""
    rows = 400_000
    message = {"type": "submit_features", "frame": 0, "bots": [1], "acquired": b"", "values": b"", field: [row] * rows}
    body = msgpack.packb(message) if form is Format.MSGPACK else msgspec.json.encode(message)
    tracemalloc.start()
    try:
        with pytest.raises(BadSchema):
            codec.decode_request(body, form)
        assert tracemalloc.get_traced_memory()[1] < 0.1 * 56 * rows
    finally:
        tracemalloc.stop()
