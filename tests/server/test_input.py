"""Hostile and broken input at every door: only documented errors, and the server goes on."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from protocol.client import BotClient
from protocol.codec import Format, body_limit
from protocol.errors import ERRORS_BY_CODE, TooManyBots
from protocol.features import CostModel
from tests.protocol.golden import BOTS, REFUSED, REQUESTS, TABLE, VECTORS, Vector
from tests.server.serving import RawStream, Served, free_numbers, http_request, serve

MSGPACK = {"Content-Type": "application/msgpack"}
LONGEST_HELLO = body_limit(TABLE, 0, Format.MSGPACK)
PATHS = ["/v1/connections", "/v1/bots/start", "/v1/query", "/v1/act", "/v1/bots/stop", "/v1/connections/close"]


@pytest.fixture(params=["tcp", "unix"])
def stream(request: pytest.FixtureRequest, served: Served) -> Iterator[RawStream]:
    with RawStream(served.addresses[request.param]) as raw:
        assert raw.frame(VECTORS["hello"].body)["type"] == "welcome"
        yield raw


def _for_these_bots(body: bytes, bots: list[int]) -> bytes:
    """The golden frame with real handles: both are nine bytes long in msgpack."""
    for golden, real in zip(BOTS, bots, strict=True):
        body = body.replace(b"\xcf" + struct.pack(">Q", golden), b"\xcf" + struct.pack(">Q", real))
    return body


@pytest.mark.parametrize("vector", REFUSED, ids=lambda vector: vector.name)
def test_golden_refusals_at_the_stream_doors(stream: RawStream, vector: Vector) -> None:
    bots = stream.frame(VECTORS["start_bots"].body)["bots"]
    reply = stream.frame(_for_these_bots(vector.body, bots))
    code = vector.description["refused_with"]
    assert (reply["type"], reply["code"]) == ("error", _after_turn_order(vector, code))
    assert stream.frame(_for_these_bots(VECTORS["stop_bots"].body, bots)) == {"type": "bots_stopped", "count": 2}


def _after_turn_order(vector: Vector, code: str) -> str:
    """No query is pending here, and that is noticed before a value that is out of range."""
    submissions = ("refused_value_out_of_range", "refused_nan_acquire_us", "refused_negative_acquire_us")
    return "NO_PENDING_QUERY" if vector.name in submissions else code


@pytest.mark.parametrize("vector", REFUSED, ids=lambda vector: vector.name)
def test_golden_refusals_at_the_http_door(served: Served, vector: Vector) -> None:
    with BotClient(served.addresses["http"]) as client:
        headers = {**MSGPACK, "X-Bot-Connection": client.hello().connection}
        body = _for_these_bots(vector.body, client.start(2).tolist())
        path = "/v1/act" if b"submit_features" in body else "/v1/query"
        path = "/v1/turn" if b"take_turn" in body else path
        path = "/v1/bots/start" if b"start_bot" in body or vector.name == "refused_too_deep" else path
        answer = http_request(served.addresses["http"], "POST", path, body, headers)
    error = msgpack.unpackb(answer.body)
    code = _after_turn_order(vector, vector.description["refused_with"])
    assert error["type"] == "error"
    assert (error["code"], answer.status) == (code, ERRORS_BY_CODE[code].status)


def test_a_frame_cut_at_any_byte_is_still_one_frame(stream: RawStream) -> None:
    for frame in (VECTORS["start_bots"].frame, VECTORS["refused_trailing"].frame):
        whole = stream.frame(frame[4:])
        for cut in range(1, len(frame)):
            stream.socket.sendall(frame[:cut])
            time.sleep(0)  # lets the server's thread see the first part alone, most of the time
            stream.socket.sendall(frame[cut:])
            reply = stream.reply()
            assert reply["type"] == whole["type"]
            if "bots" in reply:
                assert stream.frame(msgpack.packb({"type": "stop_bots", "bots": reply["bots"]}))["count"] == 2


def test_a_socket_that_closes_at_any_byte_of_a_frame_is_forgotten(served: Served) -> None:
    frame = VECTORS["hello"].frame
    for cut in range(len(frame)):
        with RawStream(served.addresses["tcp"]) as raw:
            raw.socket.sendall(frame[:cut])
    with BotClient(served.addresses["tcp"]) as client:
        assert client.hello().bundle == "tiny"


def test_two_frames_at_once_get_two_replies_in_order(stream: RawStream) -> None:
    stream.socket.sendall(VECTORS["refused_no_type"].frame + VECTORS["start_bots"].frame)
    assert [stream.reply()["type"], stream.reply()["type"]] == ["error", "bots_started"]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300))
def test_any_bytes_get_one_documented_error(stream: RawStream, body: bytes) -> None:
    reply = stream.frame(body)
    assert reply["type"] == "error"
    assert reply["code"] in ERRORS_BY_CODE
    assert reply["code"] != "INTERNAL"


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_changed_messages_get_one_documented_answer(stream: RawStream, data: st.DataObject) -> None:
    kept = [vector for vector in REQUESTS if vector.message["type"] not in ("goodbye", "start_bots", "hello")]
    body = bytearray(data.draw(st.sampled_from(kept)).body)
    for _ in range(data.draw(st.integers(1, 3))):
        body[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    reply = stream.frame(bytes(body))
    assert reply["type"] == "error"
    assert reply["code"] in ERRORS_BY_CODE
    assert reply["code"] != "INTERNAL"


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.binary(max_size=200), st.sampled_from(PATHS[1:]), st.sampled_from(["application/json", "application/msgpack"])
)
def test_any_body_gets_one_documented_error_over_http(served: Served, body: bytes, path: str, media_type: str) -> None:
    answer = http_request(served.addresses["http"], "POST", path, body, {"Content-Type": media_type})
    error = (json.loads if media_type.endswith("json") else msgpack.unpackb)(answer.body)
    assert answer.headers["content-type"] == media_type
    assert ERRORS_BY_CODE[error["code"]].status == answer.status < 500


def test_a_frame_over_the_limit_is_refused_unread_and_the_socket_closed(stream: RawStream, served: Served) -> None:
    with BotClient(served.addresses["tcp"]) as client:
        limit = client.hello().max_body_bytes
    stream.socket.sendall(struct.pack(">I", limit + 1) + b"\xc0" * 100)
    reply = stream.reply()
    assert reply["code"] == "TOO_LARGE"
    assert str(limit) in reply["detail"]
    assert stream.ended()


def test_a_client_that_goes_on_sending_a_frame_over_the_limit_still_gets_the_answer(stream: RawStream) -> None:
    stream.socket.sendall(struct.pack(">I", 2**24) + bytes(2**24))
    assert stream.reply()["code"] == "TOO_LARGE"
    assert stream.ended()


def test_a_frame_of_the_limit_is_read(stream: RawStream, served: Served) -> None:
    with BotClient(served.addresses["tcp"]) as client:
        limit = client.hello().max_body_bytes
    assert stream.frame(b"\xc0" * limit)["code"] == "BAD_MSGPACK"
    assert stream.frame(VECTORS["refused_no_type"].body)["code"] == "BAD_SCHEMA"


@pytest.mark.parametrize("path", PATHS)
def test_a_body_over_the_limit_is_413_before_it_is_decoded_or_even_read(served: Served, path: str) -> None:
    with BotClient(served.addresses["http"]) as client:
        welcome = client.hello()
        limit = LONGEST_HELLO if path == PATHS[0] else welcome.max_body_bytes
        headers = {**MSGPACK, "X-Bot-Connection": welcome.connection}
        announced = {**headers, "Content-Length": str(limit + 1)}
        answer = http_request(served.addresses["http"], "POST", path, b"", announced)  # nothing of it is ever sent
        assert (answer.status, msgpack.unpackb(answer.body)["code"]) == (413, "TOO_LARGE")
        chunks = (bytes(4096) for _ in range(limit // 4096 + 1))  # without a length: Transfer-Encoding: chunked
        answer = http_request(served.addresses["http"], "POST", path, chunks, headers)
        assert (answer.status, msgpack.unpackb(answer.body)["code"]) == (413, "TOO_LARGE")


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("named", [None, "0" * 32])
def test_without_a_connection_nothing_longer_than_a_hello_is_read(served: Served, path: str, named: str | None) -> None:
    headers = MSGPACK if named is None else {**MSGPACK, "X-Bot-Connection": named}
    too_long = (413, "TOO_LARGE") if named is None or path == PATHS[0] else (404, "NO_CONNECTION")
    announced = {**headers, "Content-Length": str(LONGEST_HELLO + 1)}
    answer = http_request(served.addresses["http"], "POST", path, b"", announced)
    assert (answer.status, msgpack.unpackb(answer.body)["code"]) == too_long
    assert answer.headers["connection"] == "close"
    chunks = (bytes(4096) for _ in range(LONGEST_HELLO // 4096 + 1))
    answer = http_request(served.addresses["http"], "POST", path, chunks, headers)
    assert (answer.status, msgpack.unpackb(answer.body)["code"]) == too_long


@pytest.mark.parametrize("door", ["tcp", "unix"])
def test_before_hello_a_stream_reads_no_more_than_a_hello(served: Served, door: str) -> None:
    with RawStream(served.addresses[door]) as raw:
        assert raw.frame(b"\xc0" * LONGEST_HELLO)["code"] == "BAD_MSGPACK"
        raw.socket.sendall(struct.pack(">I", LONGEST_HELLO + 1))
        assert raw.reply()["code"] == "TOO_LARGE"
        assert raw.ended()


@pytest.mark.parametrize("door", ["http", "tcp", "ws"])
def test_the_longest_hello_is_read(bundle: Path, tmp_path: Path, door: str) -> None:
    token = "\U0001f916" * 1024
    model = CostModel(call_us=1 / 3, feature_us=(2 / 3,) * TABLE.n_queries)
    with serve(bundle, tmp_path / "s", token=token) as served, BotClient(served.addresses[door]) as client:
        assert client.hello(token=token, bundle="tiny", cost_model=model).bundle == "tiny"
        client.start(40, seeds=[2**63 - 1] * 40, budgets_us=[1 / 3] * 40, target_returns=[1 / 3] * 40)


@pytest.mark.parametrize("media_type", ["application/json", "application/msgpack"])
def test_each_format_has_its_own_limit_and_welcome_names_it(served: Served, media_type: str) -> None:
    def answered(body: bytes) -> tuple[int, dict[str, Any]]:
        answer = http_request(served.addresses["http"], "POST", PATHS[0], body, {"Content-Type": media_type})
        return answer.status, (json.loads if media_type.endswith("json") else msgpack.unpackb)(answer.body)

    _, welcome = answered(b"{}" if media_type.endswith("json") else b"\x80")
    assert welcome["max_body_bytes"] == body_limit(TABLE, welcome["max_bots"], Format(media_type))
    limit = body_limit(TABLE, 0, Format(media_type))
    assert answered(b"\xc1" * limit)[0] == 400
    status, refused = answered(b"\xc1" * (limit + 1))
    assert (status, refused["code"]) == (413, "TOO_LARGE")


@pytest.mark.parametrize(
    ("given", "accept", "status", "answered"),
    [
        ("application/json", None, 422, "application/json"),
        ("Application/JSON; charset=utf-8", None, 422, "application/json"),
        ("application/msgpack", None, 400, "application/msgpack"),
        ("application/msgpack", "application/json", 400, "application/json"),
        ("application/json", "text/html, application/msgpack;q=0.9", 422, "application/msgpack"),
        ("application/json", "*/*", 422, "application/json"),
        ("text/plain", None, 415, "application/json"),
        ("text/plain", "application/msgpack", 415, "application/msgpack"),
        (None, None, 415, "application/json"),
    ],
)
def test_content_types(served: Served, given: str | None, accept: str | None, status: int, answered: str) -> None:
    headers = {name: value for name, value in (("Content-Type", given), ("Accept", accept)) if value is not None}
    answer = http_request(served.addresses["http"], "POST", "/v1/connections", b'{"protocol":2}', headers)
    assert (answer.status, answer.headers["content-type"]) == (status, answered)


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/", 404, "NO_ROUTE"),
        ("POST", "/v1/bots", 404, "NO_ROUTE"),
        ("GET", "/v1/../../etc/passwd", 404, "NO_ROUTE"),
        ("GET", "/v1/query", 405, "METHOD_NOT_ALLOWED"),
        ("DELETE", "/v1/connections", 405, "METHOD_NOT_ALLOWED"),
        ("POST", "/healthz", 405, "METHOD_NOT_ALLOWED"),
    ],
)
def test_other_paths_and_methods_get_error_messages_too(
    served: Served, method: str, path: str, status: int, code: str
) -> None:
    answer = http_request(served.addresses["http"], method, path)
    assert (answer.status, json.loads(answer.body)["code"]) == (status, code)


def test_too_many_bots_say_when_to_try_again_and_start_none(client: BotClient) -> None:
    room = client.welcome.max_bots
    with pytest.raises(TooManyBots, match=f"{room + 1} bots never fit: there are {room} slots") as refusal:
        client.start(room + 1)
    assert refusal.value.retry_after_s is None
    bots = client.start(room)
    with pytest.raises(TooManyBots) as refusal:
        client.start(1)
    assert refusal.value.retry_after_s
    assert len(client.query(bots, 0, free_numbers(TABLE, room, 0)).queries) == room
    assert client.stop(bots) == room
    assert np.unique(np.concatenate([bots, client.start(room)])).size == 2 * room


def test_refusals_for_lack_of_room_carry_retry_after_over_http(served: Served) -> None:
    with BotClient(served.addresses["http"]) as client:
        headers = {**MSGPACK, "X-Bot-Connection": client.hello().connection}
        client.start(client.welcome.max_bots)
        for count, retry_after in ((1, "1"), (65536, None)):
            body = msgpack.packb({"count": count})
            answer = http_request(served.addresses["http"], "POST", "/v1/bots/start", body, headers)
            assert (answer.status, answer.headers.get("retry-after")) == (429, retry_after)
