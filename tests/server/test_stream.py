"""Deadlines and draining of the stream door. Deadlines are short here, and what is waited for is the server's close."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest

from protocol.client import BotClient
from tests.protocol.golden import TABLE, VECTORS
from tests.server.serving import RawStream, Served, http_request, play, serve

HELLO = VECTORS["hello"]


@pytest.fixture(scope="module")
def hasty(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve(bundle, tmp_path_factory.mktemp("hasty") / "s", frame_deadline_s=0.2, idle_ttl_s=30.0) as running:
        yield running


@pytest.mark.parametrize("door", ["tcp", "unix"])
@pytest.mark.parametrize("sent", [b"", HELLO.frame[:1], HELLO.frame[:4], HELLO.frame[:-1]])
def test_a_socket_that_does_not_say_hello_in_time_is_closed(hasty: Served, door: str, sent: bytes) -> None:
    with RawStream(hasty.addresses[door]) as raw:
        raw.socket.sendall(sent)
        assert raw.ended()


def test_a_frame_that_does_not_end_in_time_closes_the_socket_and_a_silent_one_stays(hasty: Served) -> None:
    with RawStream(hasty.addresses["tcp"]) as silent, RawStream(hasty.addresses["tcp"]) as slow:
        assert silent.frame(HELLO.body)["type"] == "welcome"
        assert slow.frame(HELLO.body)["type"] == "welcome"
        slow.socket.sendall(struct.pack(">I", 100) + b"\x80")
        assert slow.ended()
        assert silent.frame(VECTORS["start_bots"].body)["type"] == "bots_started"


def _flood(deaf: RawStream) -> None:
    body = msgpack.packb({"type": "stop_bots", "bots": [0] * 60000})
    for _ in range(10**6):
        deaf.socket.sendall(struct.pack(">I", len(body)) + body)


def test_a_client_that_does_not_read_its_replies_is_closed(hasty: Served) -> None:
    with RawStream(hasty.addresses["unix"]) as deaf:
        deaf.frame(HELLO.body)
        with pytest.raises(ConnectionError):
            _flood(deaf)


def test_a_silent_socket_is_closed_after_the_time_to_live(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", idle_ttl_s=0.2) as served, RawStream(served.addresses["tcp"]) as silent:
        silent.frame(HELLO.body)
        assert silent.ended()


def test_a_body_that_does_not_end_in_time_is_refused(hasty: Served) -> None:
    headers = {"Content-Type": "application/msgpack", "Content-Length": "10"}
    answer = http_request(hasty.addresses["http"], "POST", "/v1/query", b"\x80", headers)
    assert (answer.status, msgpack.unpackb(answer.body)["code"]) == (400, "BAD_MSGPACK")
    assert answer.headers["connection"] == "close"


def test_stopping_answers_what_is_in_progress_and_closes_the_rest(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s") as served:
        clients = [BotClient(served.addresses[door]) for door in ("tcp", "unix", "http")]
        turns, stopping = [0] * len(clients), threading.Event()

        def busy(index: int) -> None:
            client = clients[index]
            client.hello()
            bots = client.start(4)
            try:
                for frame in range(10**6):
                    play(client, TABLE, bots, range(frame, frame + 1))
                    turns[index] += 1
                    if turns[index] == 20:
                        stopping.set()
            except OSError:
                pass  # closed between two requests: the only way to end

        threads = [threading.Thread(target=busy, args=(index,)) for index in range(len(clients))]
        for thread in threads:
            thread.start()
        stopping.wait()
        served.stop()
        for thread in threads:
            thread.join()
        for client in clients:
            client.close()
        assert max(turns) >= 20


def test_no_thread_or_socket_is_left_behind(bundle: Path, tmp_path: Path) -> None:
    before = threading.active_count()
    with serve(bundle, tmp_path / "s") as served:
        for _ in range(10):
            with BotClient(served.addresses["unix"]) as client:
                client.hello()
    assert threading.active_count() == before
    assert not (tmp_path / "s").exists()
