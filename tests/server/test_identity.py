"""Whose bots they are: connections, tokens, limits, time to live."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import msgpack
import numpy as np
import pytest

from protocol import transport, websocket
from protocol.client import BotClient
from protocol.errors import NoBot, NoConnection, ProtocolError, TooManyBots, TooManyConnections, Unauthorized
from tests.protocol.golden import TABLE, VECTORS
from tests.server.serving import (
    FakeClock,
    RawStream,
    Served,
    costly_numbers,
    free_numbers,
    http_request,
    play,
    same,
    serve,
)


def test_another_connections_bots_look_like_none_at_all(client: BotClient, served: Served) -> None:
    clean = play(client, TABLE, client.start(2, seeds=[1, 2]), range(6))
    bots = client.start(2, seeds=[1, 2])
    played = play(client, TABLE, bots, range(3))
    free, costly = free_numbers(TABLE, 2, 3), costly_numbers(TABLE, 2, 3)
    for door in ("http", "tcp", "unix", "ws"):
        with BotClient(served.addresses[door]) as other:
            other.hello()
            own = other.start(1)
            none = np.zeros((2, TABLE.n_queries), dtype=bool)
            for request in (
                lambda: other.query(bots, 3, free),
                lambda: other.query([own[0], bots[0]], 3, free),  # noqa: B023
                lambda: other.act(bots, 2, none, costly),  # noqa: B023
                lambda: other.stop(bots),
            ):
                with pytest.raises(NoBot) as refusal:
                    request()
                theirs = refusal.value.detail.replace(str(bots[0]), "X")
                with pytest.raises(NoBot) as refusal:
                    other.stop([own[0] + 2**32])
                assert refusal.value.detail.replace(str(own[0] + 2**32), "X") == theirs
    assert same(played + play(client, TABLE, bots, range(3, 6)), clean)


def test_stopped_bots_are_gone(client: BotClient) -> None:
    bots = client.start(2)
    assert client.stop(bots[:1]) == 1
    for handles in (bots, bots[:1]):
        with pytest.raises(NoBot):
            client.stop(handles)
    assert client.stop(bots[1:]) == 1


def test_before_hello_there_is_no_connection(served: Served) -> None:
    with RawStream(served.addresses["tcp"]) as raw:
        assert raw.frame(VECTORS["start_bots"].body)["code"] == "NO_CONNECTION"
        assert raw.frame(VECTORS["hello"].body)["type"] == "welcome"
        assert raw.frame(VECTORS["hello"].body)["code"] == "BAD_SCHEMA"
        assert raw.frame(VECTORS["start_bots"].body)["type"] == "bots_started"
        assert raw.frame(VECTORS["goodbye"].body) == {"type": "farewell"}
        assert raw.ended()
    for connection in ({}, {"X-Bot-Connection": ""}, {"X-Bot-Connection": "0" * 32}):
        headers = {"Content-Type": "application/json", **connection}
        answer = http_request(served.addresses["http"], "POST", "/v1/bots/start", b'{"count":1}', headers)
        assert (answer.status, json.loads(answer.body)["code"]) == (404, "NO_CONNECTION")


def test_connection_names_cannot_be_guessed(served: Served) -> None:
    names = set()
    for _ in range(20):
        with BotClient(served.addresses["http"]) as client:
            names.add(client.hello().connection)
    assert len(names) == 20
    assert all(len(name) == 32 and int(name, 16) >= 0 for name in names)


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_the_end_of_a_connection_frees_its_bots(served: Served, door: str) -> None:
    address = served.addresses[door]
    for _ in range(3):
        with BotClient(address) as client:
            client.start(client.hello().max_bots)
    with BotClient(address) as client:
        client.hello()
        connection = client.welcome.connection
        client.exchange({"type": "goodbye"})
        if door == "http":
            headers = {"Content-Type": "application/msgpack", "X-Bot-Connection": connection}
            body = VECTORS["start_bots"].body
            assert msgpack.unpackb(http_request(address, "POST", "/v1/bots/start", body, headers).body)["code"] == (
                "NO_CONNECTION"
            )


def test_a_socket_that_just_closes_frees_its_bots(served: Served) -> None:
    for _ in range(20):
        with RawStream(served.addresses["tcp"]) as raw:
            raw.frame(VECTORS["hello"].body)
            assert _until_started(raw)
            raw.socket.close()


def _until_started(raw: RawStream) -> bool:
    """All the bots there are; the server may need a moment to notice that the last socket closed."""
    message = msgpack.packb({"type": "start_bots", "count": 256})
    return any(raw.frame(message)["type"] == "bots_started" for _ in range(2000))


def test_the_bots_of_a_silent_connection_are_freed_without_anyone_saying_hello(bundle: Path, tmp_path: Path) -> None:
    clock = FakeClock()
    with serve(bundle, tmp_path / "s", clock, idle_ttl_s=0.2, max_bots=1) as served:
        http = served.addresses["http"]
        with BotClient(http) as silent, BotClient(http) as talking:
            silent.hello()
            silent.start(1)
            clock.now += 0.1
            talking.hello()
            clock.now += 0.15
            assert any(_starts(talking) for _ in range(10**4))


def _starts(client: BotClient) -> bool:
    try:
        return client.start(1).size == 1
    except TooManyBots:
        return False


def test_tokens(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", token="s3cret é") as served:
        for door in ("http", "tcp", "unix", "ws"):
            with BotClient(served.addresses[door]) as client:
                for token in (None, "", "s3cret", "s3cret é "):
                    with pytest.raises(Unauthorized):
                        client.hello(token=token)
                client.hello(token="s3cret é")
                assert client.stop(client.start(1)) == 1
        for header in ({}, {"Authorization": "Bearer nope"}, {"Authorization": "Basic s3cret"}):
            answer = http_request(served.addresses["http"], "GET", "/v1/bundle", headers=header)
            assert (answer.status, json.loads(answer.body)["code"]) == (401, "UNAUTHORIZED")
    with serve(bundle, tmp_path / "s", token="plain") as served:
        answer = http_request(served.addresses["http"], "GET", "/v1/bundle", headers={"Authorization": "Bearer plain"})
        assert json.loads(answer.body)["name"] == "tiny"


def test_connections_are_limited_and_those_that_exist_go_on(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", max_connections=2, max_bots=4) as served:
        http = served.addresses["http"]
        with BotClient(http) as first, BotClient(http) as second, BotClient(http) as third:
            first.hello()
            second.hello()
            bots = first.start(4)
            with pytest.raises(TooManyConnections) as refusal:
                third.hello()
            assert refusal.value.retry_after_s
            with pytest.raises(TooManyBots):
                second.start(1)
            play(first, TABLE, bots, range(2))
            second.close()
            third.hello()


def test_stream_sockets_are_limited(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", max_connections=1) as served, BotClient(served.addresses["tcp"]) as first:
        first.hello()
        with RawStream(served.addresses["unix"]) as raw:
            assert raw.frame(VECTORS["hello"].body)["code"] == "TOO_MANY_CONNECTIONS"
            assert raw.ended()
        with RawStream(served.addresses["tcp"]) as raw:
            assert raw.ended(), "who says nothing is not waited for"
        for door in ("tcp", "unix"):
            with BotClient(served.addresses[door]) as other:
                for _ in range(3):
                    with pytest.raises(TooManyConnections):
                        other.hello()
        assert first.stop(first.start(1)) == 1
        first.close()
        with BotClient(served.addresses["unix"]) as other:
            assert _until_welcome(other)


def _until_welcome(client: BotClient) -> bool:
    """The server may need a moment to notice that the last socket closed."""
    for _ in range(2000):
        with suppress(TooManyConnections):
            return client.hello() is not None
    return False


def test_requests_that_are_refused_keep_a_connection_and_its_socket_outlives_one_that_has_ended(
    bundle: Path, tmp_path: Path
) -> None:
    clock = FakeClock()
    with serve(bundle, tmp_path / "s", clock, idle_ttl_s=60.0) as served, RawStream(served.addresses["tcp"]) as raw:
        assert raw.frame(VECTORS["hello"].body)["type"] == "welcome"
        bots = raw.frame(msgpack.packb({"type": "start_bots", "count": 1}))["bots"]
        for _ in range(4):
            clock.now += 40.0
            assert raw.frame(msgpack.packb({"type": "stop_bots"}))["code"] == "BAD_SCHEMA"
        assert raw.frame(VECTORS["hello"].body)["code"] == "BAD_SCHEMA"
        assert raw.frame(msgpack.packb({"type": "stop_bots", "bots": bots}))["type"] == "bots_stopped"
        clock.now += 61.0
        assert raw.frame(msgpack.packb({"type": "start_bots", "count": 1}))["code"] == "NO_CONNECTION"
        assert raw.frame(VECTORS["hello"].body)["type"] == "welcome"


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_a_client_may_say_hello_again(bundle: Path, tmp_path: Path, door: str) -> None:
    """Over HTTP the bots of before last for their time to live: on a server that no other test needs."""
    with serve(bundle, tmp_path / "s") as served, BotClient(served.addresses[door]) as client:
        first = client.hello().connection
        client.start(1)
        assert client.hello().connection != first
        assert client.stop(client.start(1)) == 1


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_an_answer_that_was_not_waited_for_is_nobodys(
    bundle: Path, tmp_path: Path, door: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while a request is under way, and the program goes on; on a server of its own, as above."""

    def interrupted(*_: object) -> bytes:
        raise KeyboardInterrupt

    with serve(bundle, tmp_path / "s") as served, BotClient(served.addresses[door]) as client:
        client.hello()
        with monkeypatch.context() as patch:
            for name in ("_read_http", "_read_frame"):
                patch.setattr(transport, name, interrupted)
            patch.setattr(websocket.WebSocketTransport, "_receive", interrupted)
            with pytest.raises(KeyboardInterrupt):
                client.start(2)
        client.hello()
        assert client.start(1).size == 1


def test_a_summary_may_be_asked_for_by_name(served: Served) -> None:
    answers = [http_request(served.addresses["http"], "GET", f"/v1/bundle?name={name}") for name in ("tiny", "nope")]
    assert [answer.status for answer in answers] == [200, 404]
    assert json.loads(answers[0].body)["name"] == "tiny"
    assert json.loads(answers[1].body)["code"] == "NO_BUNDLE"


def test_a_silent_connection_ends_and_its_bots_with_it(bundle: Path, tmp_path: Path) -> None:
    clock = FakeClock()
    with serve(bundle, tmp_path / "s", clock, idle_ttl_s=60.0, max_bots=2) as served:
        http = served.addresses["http"]
        with BotClient(http) as silent, BotClient(http) as talking:
            silent.hello()
            bots = silent.start(2)
            talking.hello()
            clock.now += 59.0
            silent.query(bots, 0, free_numbers(TABLE, 2, 0))
            with pytest.raises(ProtocolError):
                talking.start(1)
            clock.now += 59.0
            with pytest.raises(ProtocolError):
                talking.start(1)
            clock.now += 2.0
            with pytest.raises(NoConnection):
                silent.query(bots, 1, free_numbers(TABLE, 2, 1))
            with BotClient(http) as third:
                third.hello()  # sweeps
                assert third.start(2).size == 2
