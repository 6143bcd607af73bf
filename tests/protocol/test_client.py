"""The client against servers that misbehave: scripted sockets on loopback."""

from __future__ import annotations

import itertools
import socket
import struct
import threading
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.client import BotClient, ReplyError
from protocol.errors import BadSchema, BadShape, InternalError, NoConnection, ProtocolError
from protocol.replies import read_actions, read_queries, read_reply, read_welcome
from tests.protocol.golden import BOTS, REPLIES, TABLE, VECTORS, WELCOME

FREE = np.zeros((2, TABLE.n_free), dtype=np.float32)


def http_reply(body: bytes, content_type: str = "application/msgpack") -> bytes:
    head = f"HTTP/1.1 200 OK\r\nContent-Type: {content_type}\r\nContent-Length: {len(body)}\r\n\r\n"
    return head.encode() + body


@contextmanager
def scripted(*sockets: list[bytes]) -> Iterator[tuple[int, list[bytes]]]:
    """A server that answers each socket's requests with these bytes and then closes it; yields port and requests."""
    listening = socket.create_server(("127.0.0.1", 0))
    heard: list[bytes] = []

    def serve() -> None:
        for replies in sockets:
            accepted, _ = listening.accept()
            with accepted:
                for reply in replies:
                    heard.append(accepted.recv(65536))
                    accepted.sendall(reply)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield listening.getsockname()[1], heard
    finally:
        thread.join()
        listening.close()


@pytest.mark.parametrize(
    "url",
    [
        "",
        "http://",
        "http://host",
        "tcp://host",
        "tcp://:80",
        "ftp://host:1",
        "unix://relative",
        "http://host:1/path",
        "ftp://h:1",
    ],
)
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(ValueError, match="none of"):
        BotClient(url)


def test_before_hello_nothing_can_be_asked_and_closing_is_fine() -> None:
    with BotClient("tcp://127.0.0.1:1") as client, pytest.raises(NoConnection):
        client.query(BOTS, 0, FREE)


def test_arrays_of_another_shape_are_refused_before_they_are_sent() -> None:
    with scripted([VECTORS["welcome"].frame]) as (port, heard):
        client = BotClient(f"tcp://127.0.0.1:{port}")
        client.hello()
        none = np.zeros((2, TABLE.n_queries), dtype=bool)
        costly = np.zeros((2, TABLE.n_costly), dtype=np.float32)
        for request in (
            lambda: client.query(BOTS, 0, FREE[:, 1:]),
            lambda: client.query(BOTS[:1], 0, FREE),
            lambda: client.act(BOTS, 0, none[:, 1:], costly),
            lambda: client.act(BOTS, 0, none, costly[:1]),
            lambda: client.act(BOTS, 0, none, costly, failed=none[0]),
        ):
            with pytest.raises(BadShape):
                request()
        client._transport.close()
    assert heard == [VECTORS["hello"].frame]


def test_handles_that_became_floats_are_refused_before_they_reach_another_bot() -> None:
    """`np.append` of an empty array makes them floats, and rounds them."""
    with scripted([VECTORS["welcome"].frame]) as (port, heard):
        client = BotClient(f"tcp://127.0.0.1:{port}")
        client.hello()
        with pytest.raises(BadSchema, match="bots are float64, expected whole numbers"):
            client.query(np.append(np.array([]), BOTS), 0, FREE)
        with pytest.raises(TypeError):
            client.query(BOTS, 0.5, FREE)  # type: ignore[arg-type]
        client._transport.close()
    assert heard == [VECTORS["hello"].frame]


def test_a_late_answer_is_never_taken_for_the_next_one() -> None:
    frames = [VECTORS["welcome"].frame, VECTORS["queries"].frame]
    with scripted(frames) as (port, _):
        client = BotClient(f"tcp://127.0.0.1:{port}")
        client.hello()
        with pytest.raises(ReplyError, match="frame 7"):
            client.query(BOTS, 8, FREE)
        assert client._transport._socket is None


def test_an_answer_that_comes_after_its_deadline_is_late_whatever_it_says() -> None:
    ticks_ns = itertools.count(0, 1_000_000)  # a clock that is looked at every ms
    frames = [VECTORS[name].frame for name in ("welcome", "queries", "queries", "queries")]
    with scripted(frames) as (port, _):
        client = BotClient(f"tcp://127.0.0.1:{port}", clock=ticks_ns.__next__)
        client.hello()
        late = [client.query(BOTS, 7, FREE, deadline_us=us).late for us in (1000.0, 999.0, None)]
        assert late == [False, True, False]
        assert client.n_late == 1
        client._transport.close()


def test_what_cannot_be_read_closes_the_socket_and_the_next_hello_dials_anew() -> None:
    odd = [msgpack.packb({"type": kind}) for kind in ("welcome", "bots_started", "bots_stopped", "queries")]
    bad = [struct.pack(">I", len(body)) + body for body in odd]
    welcome = VECTORS["welcome"].frame
    with scripted([bad[0]], [welcome, bad[1]], [welcome, bad[2]], [welcome, bad[3]], [welcome]) as (port, _):
        client = BotClient(f"tcp://127.0.0.1:{port}")
        with pytest.raises(ReplyError):
            client.hello()
        for ask in (lambda: client.start(2), lambda: client.stop(BOTS), lambda: client.query(BOTS, 7, FREE)):
            client.hello()
            with pytest.raises(ReplyError):
                ask()
            assert client._transport._socket is None
        client.hello()
        client._transport.close()


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"\0\0",
        struct.pack(">I", 5) + b"\x80",
        struct.pack(">I", 2**31),
        struct.pack(">I", 1) + b"\xc1",
        VECTORS["farewell"].frame,
    ],
)
def test_broken_answers_on_a_stream_are_connection_errors(reply: bytes) -> None:
    with scripted([reply]) as (port, _):
        client = BotClient(f"tcp://127.0.0.1:{port}")
        with pytest.raises(ConnectionError):
            client.hello()
        client._transport.close()


@pytest.mark.parametrize(
    "reply",
    [
        b"",
        b"nonsense\r\n\r\n",
        http_reply(b"<html>", "text/html"),
        http_reply(b"\xc1"),
        http_reply(b"\x80"),
        http_reply(VECTORS["farewell"].body),
    ],
)
def test_broken_answers_over_http_are_connection_errors(reply: bytes) -> None:
    with scripted([reply]) as (port, _):
        client = BotClient(f"http://127.0.0.1:{port}")
        with pytest.raises(ConnectionError):
            client.hello()
        client._transport.close()


def test_a_silent_server_is_a_timeout() -> None:
    listening = socket.create_server(("127.0.0.1", 0))
    with listening:
        for scheme in ("tcp", "http"):
            with (
                BotClient(f"{scheme}://127.0.0.1:{listening.getsockname()[1]}", timeout_s=0.05) as client,
                pytest.raises(TimeoutError),
            ):
                client.hello()


def test_a_turn_whose_keep_alive_socket_was_closed_is_sent_again_and_a_start_is_not() -> None:
    welcome, queries = http_reply(VECTORS["welcome"].body), http_reply(VECTORS["queries"].body)
    with scripted([welcome], [queries]) as (port, heard):
        client = BotClient(f"http://127.0.0.1:{port}")
        client.hello()
        assert client.query(BOTS, 7, FREE).frame == 7
        client._transport.close()
        assert WELCOME.connection.encode() in heard[1]
    with scripted([welcome]) as (port, heard):
        client = BotClient(f"http://127.0.0.1:{port}")
        client.hello()
        with pytest.raises(ConnectionError):
            client.start(1)
        assert len(heard) == 1


def test_codes_and_fields_of_a_newer_server() -> None:
    with pytest.raises(InternalError, match="BRAND_NEW: why"):
        read_reply(msgpack.packb({"type": "error", "code": "BRAND_NEW", "detail": "why"}), "goodbye")
    newer = {**VECTORS["welcome"].message, "colour": 1}
    newer["features"] = {"features": [{**each, "unit": "m"} for each in newer["features"]["features"]], "more": 1}
    assert read_welcome(newer).features == TABLE


@pytest.mark.parametrize("name", ["target_cost_us", "cost_quantile"])
def test_a_welcome_of_a_server_that_is_older_than_a_field(name: str) -> None:
    older = {field: value for field, value in VECTORS["welcome"].message.items() if field != name}
    assert getattr(read_welcome(older), name) is None


def test_an_array_bomb_takes_no_more_memory_than_its_bytes_could_fill() -> None:
    bomb = b"\xdd\x00\x01\x00\x00" * 800  # arrays in arrays that claim 65,536 entries each
    tracemalloc.start()
    try:
        with pytest.raises(ReplyError):
            read_reply(bomb, "hello")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


@given(st.binary(max_size=100) | st.sampled_from([v.body for v in REPLIES]), st.data())
def test_whatever_a_server_answers_only_documented_errors_come_out(body: bytes, data: st.DataObject) -> None:
    changed = bytearray(body)
    for _ in range(data.draw(st.integers(0, 3)) if body else 0):
        changed[data.draw(st.integers(0, len(body) - 1))] = data.draw(st.integers(0, 255))
    for kind, read in (
        ("hello", read_welcome),
        ("request_queries", lambda reply: read_queries(reply, 2, TABLE)),
        ("submit_features", lambda reply: read_actions(reply, 2, WELCOME.action)),
    ):
        try:
            read(read_reply(bytes(changed), kind))
        except (ReplyError, ProtocolError):
            continue
