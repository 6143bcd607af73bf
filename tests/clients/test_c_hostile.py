"""The C client before servers that misbehave, and callers that do: an error each time, under silent sanitizers."""

from __future__ import annotations

import random
import socket
import struct
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from tests.clients.engine import CClient, Refused, Turn
from tests.clients.faults import frame_of, mutated, plain, without
from tests.protocol.golden import BOTS, TABLE, VECTORS
from tests.protocol.test_client import scripted

FREE = np.zeros((2, TABLE.n_free))
NONE = np.zeros((2, TABLE.n_queries), dtype=bool)
COSTLY = np.zeros((2, TABLE.n_costly))
WELCOME, QUERIES, ACTIONS = (VECTORS[name].frame for name in ("welcome", "queries", "actions"))
N_FRAMES = 2000


def answered(built: Path, *replies: bytes, call: str = "query", frame: int = 7, **how: Any) -> Turn | list[str]:
    """What a turn of the golden bots returns where the server answers hello and it with these bytes, then hangs up."""
    with scripted([*replies]) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}", **how) as client:
        said = client.hello()
        if len(replies) == 1:
            return said
        try:
            if call == "start":
                client.start(2)
            return client.turn(call, BOTS, frame, free=FREE, acquired=NONE, costly=COSTLY)
        except Refused as refusal:
            if refusal.status in ("BAD_REPLY", "CLOSED"):
                with pytest.raises(Refused, match="NO_CONNECTION"):  # the socket is closed, for a late reply may come
                    client.stop(BOTS)
            raise


@pytest.mark.parametrize(
    ("reply", "status"),
    [
        (b"", "CLOSED"),
        (b"\0\0", "CLOSED"),
        (QUERIES[:-1], "CLOSED"),
        (struct.pack(">I", 2**20) + b"\x80", "CLOSED"),
        (struct.pack(">I", 0), "BAD_REPLY"),
        (struct.pack(">I", 64 * 2**20 + 1), "BAD_REPLY"),
        (struct.pack(">I", 2**32 - 1), "BAD_REPLY"),
        (struct.pack(">I", 1) + b"\xc1", "BAD_REPLY"),
        (struct.pack(">I", 5) + b"\xdf\xff\xff\xff\xff", "BAD_REPLY"),
        (struct.pack(">I", 2**17) + b"\x91" * 2**17, "BAD_REPLY"),
        (QUERIES + b"\0", "BAD_REPLY"),
        (frame_of([]), "BAD_REPLY"),
        (frame_of({}), "BAD_REPLY"),
        (frame_of({"type": 7}), "BAD_REPLY"),
        (frame_of({1: 2, **plain("queries")}), "BAD_REPLY"),
        (ACTIONS, "BAD_REPLY"),
        (frame_of(plain("queries", queries=b"")), "BAD_REPLY"),
        (frame_of(plain("queries", cost_us=[1.0])), "BAD_REPLY"),
        (frame_of(plain("queries", frame=8)), "BAD_REPLY"),
        (frame_of({"type": "error", "code": "NO_BOT"}), "BAD_REPLY"),
        (frame_of({"type": "error", "code": "NO_BOT", "detail": "", "retry_after_s": float("nan")}), "BAD_REPLY"),
    ],
)
def test_what_is_no_reply_is_an_error_and_ends_the_connection(reply: bytes, status: str, built: Path) -> None:
    with pytest.raises(Refused) as refusal:
        answered(built, WELCOME, reply)
    assert refusal.value.status == status
    assert refusal.value.code == ""
    if status == "BAD_REPLY":
        with pytest.raises(Refused, match="BAD_REPLY"):
            answered(built, reply)


def test_fields_and_codes_of_a_newer_server_and_of_an_older_one(built: Path) -> None:
    newer = frame_of({"colour": [{"a": {"b": [1, None]}}], **plain("queries"), "shade": msgpack.ExtType(5, b"x")})
    assert isinstance(answered(built, WELCOME, newer), Turn)
    for name, reply in (("query", without("queries", "reasons", "late")), ("act", without("actions", "turns", "late"))):
        turn = answered(built, WELCOME, frame_of(reply), call=name)
        assert isinstance(turn, Turn)
        assert (turn.numbers is None, turn.late) == (name == "act", False)
    text = "why \x1b[2J\0é"
    with pytest.raises(Refused) as refusal:
        answered(built, WELCOME, frame_of({"type": "error", "code": "BRAND_NEW", "detail": text + "." * 999}))
    assert (refusal.value.status, refusal.value.code) == ("INTERNAL", "BRAND_NEW")
    assert refusal.value.detail.startswith("why ?[2J???..")
    assert len(refusal.value.detail) == 300
    newest = ("target_cost_us", "cost_quantile", "bundle_version", "bundle_sha256", "replay_frames", "target_return")
    older = frame_of(without("welcome", *newest, "deadline_us"))
    with scripted([older]) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        client.hello()
        for name, told in (
            ("query", {"deadline_us": 1.0}),
            ("query", {"budgets_us": [1.0, 1.0]}),
            ("act", {"acquire_us": 1.0}),
            ("take", {}),
        ):
            with pytest.raises(Refused, match="UNSUPPORTED"):
                client.turn(name, BOTS, 7, free=FREE, acquired=NONE, costly=COSTLY, **told)
    assert len(heard) == 1


def test_a_connection_that_has_ended_at_the_server_has_ended_here_and_hello_begins_another(built: Path) -> None:
    ended = frame_of({"type": "error", "code": "NO_CONNECTION", "detail": "silent for too long"})
    sockets = [WELCOME, ended], [WELCOME, QUERIES]
    with scripted(*sockets) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        client.hello()
        for code in ("NO_CONNECTION", ""):  # the server's first, then this side's own
            with pytest.raises(Refused, match="NO_CONNECTION") as refusal:
                client.turn("query", BOTS, 7, free=FREE)
            assert refusal.value.code == code
        client.hello()
        assert client.turn("query", BOTS, 7, free=FREE).infer_us == 80.25


def test_arguments_that_cannot_be_sent_are_not(built: Path) -> None:
    for url in ("", "http://127.0.0.1:1", "tcp://host", "tcp://:1", "tcp://h:0", "tcp://h:65536", "tcp://h:1/x",
                "tcp://[::1", "unix://s", "unix:///" + "x" * 200):  # fmt: skip
        with pytest.raises(Refused, match="BAD_ARGUMENT"), CClient(built, url):
            pass
    small = frame_of(plain("welcome", max_body_bytes=60))
    with scripted([small]) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        with pytest.raises(Refused, match="NO_CONNECTION"):
            client.start(1)
        client.hello()
        for call in (
            lambda: client.start(0),
            lambda: client.start(65537),
            lambda: client.start(1, seeds=[-1]),
            lambda: client.stop([]),
            lambda: client.turn("query", [], 7, free=FREE),
            lambda: client.turn("query", BOTS, -1, free=FREE),
            lambda: client.turn("query", BOTS, 2**53 + 1, free=FREE),
            lambda: client.turn("query", BOTS, 7),
            lambda: client.turn("act", BOTS, 7, acquired=NONE),
            lambda: client.turn("query", BOTS, 7, free=FREE),  # longer than max_body_bytes
        ):
            with pytest.raises(Refused, match="BAD_ARGUMENT"):
                call()
    assert len(heard) == 1


def test_nobody_there_and_nobody_answering(built: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        with CClient(built, url, timeout_ms=50) as client, pytest.raises(Refused, match="TIMEOUT"):
            client.hello()
        for spin_us in (-1, 10_001):
            with pytest.raises(Refused, match="BAD_ARGUMENT"), CClient(built, url, spin_us=spin_us):
                pass
    for nobody in (url, f"unix://{tmp_path}/none"):
        with pytest.raises(Refused, match="SYSTEM"), CClient(built, nobody):
            pass


def test_who_polls_does_not_sleep_before_its_time_nor_past_the_timeout(built: Path) -> None:
    """Nobody answers, and each look at the client's own clock takes it 1 ms on."""
    told = {"timeout_ms": 100, "look_step_ns": 10**6}
    counts = {}
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        for spin_us in (0, 10_000):
            with CClient(built, url, spin_us=spin_us, **told) as client:
                with pytest.raises(Refused, match="TIMEOUT"):
                    client.hello()
                counts[spin_us] = client.counts()
        with CClient(built, url, spin_us=10_000, **{**told, "timeout_ms": 5}) as client:
            with pytest.raises(Refused, match="TIMEOUT"):
                client.hello()
            timed_out = client.counts()
    assert counts[0].yields == 0 < counts[0].sleeps
    assert 0 < counts[10_000].yields <= 10
    assert counts[10_000].sleeps > 0  # the rest of its timeout
    assert (timed_out.yields <= 5, timed_out.sleeps) == (True, 0)


def test_an_answer_is_late_by_the_engines_clock_whatever_it_says(built: Path) -> None:
    """A clock that is looked at before a request and after its answer, and goes 1 ms each time."""
    replies = [WELCOME, QUERIES, QUERIES, QUERIES, ACTIONS]
    with scripted(replies) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}", clock_step_ns=10**6) as client:
        client.hello()
        late = [client.turn("query", BOTS, 7, free=FREE, deadline_us=us).late for us in (1000.0, 999.0, None)]
        late.append(client.turn("act", BOTS, 7, acquired=NONE, costly=COSTLY, deadline_us=0.0).late)
        assert late == [False, True, False, True]
        assert client.counts().late == 2
    default = frame_of(plain("welcome", deadline_us=999.0))
    turn = answered(built, default, QUERIES, clock_step_ns=10**6)
    assert isinstance(turn, Turn)
    assert turn.late


@pytest.mark.parametrize("spin_us", [0, 10_000])
def test_a_reply_may_come_byte_by_byte(built: Path, spin_us: int) -> None:
    def dribble(listening: socket.socket) -> None:
        accepted, _ = listening.accept()
        with accepted:
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for reply in (WELCOME, QUERIES):
                accepted.recv(65536)
                for byte in reply:
                    accepted.sendall(bytes([byte]))

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=dribble, args=[listening], daemon=True)
        thread.start()
        with CClient(built, f"tcp://127.0.0.1:{listening.getsockname()[1]}", spin_us=spin_us) as client:
            client.hello()
            assert client.turn("query", BOTS, 7, free=FREE).infer_us == 80.25
        thread.join()


def test_where_memory_ends_nothing_else_does(built: Path) -> None:
    """The engine's allocator refuses from its first call on, from its second, and so on until nothing is refused."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        thread = threading.Thread(target=answer_forever, args=[listening], daemon=True)
        thread.start()
        refusals = [refusal_of_a_turn(built, url, n_allowed) for n_allowed in range(20)]
        with socket.create_connection(listening.getsockname()) as last:
            last.sendall(b"goodbye")
        thread.join()
    n = refusals.index("")
    assert n > 8
    assert refusals == ["NO_MEMORY"] * n + [""] * (20 - n)


def refusal_of_a_turn(built: Path, url: str, n_allowed: int) -> str:
    try:
        with CClient(built, url, n_allowed=n_allowed) as client:
            client.hello()
            client.start(2)
            client.turn("query", BOTS, 7, free=FREE)
    except Refused as refusal:
        return refusal.status
    return ""


def answer_forever(listening: socket.socket) -> None:
    """Golden replies to each socket in turn, until one says goodbye."""
    replies = {b"hello": WELCOME, b"start_bots": VECTORS["bots_started"].frame, b"request_queries": QUERIES}
    while True:
        accepted, _ = listening.accept()
        with accepted, suppress(ConnectionError):
            while heard := accepted.recv(65536):
                if heard == b"goodbye":
                    return
                accepted.sendall(next(reply for kind, reply in replies.items() if kind in heard))


def test_mutated_frames_on_a_socket_are_errors_and_the_next_connection_works(built: Path, tmp_path: Path) -> None:
    rng = random.Random(22)
    frames = [mutated(QUERIES, [WELCOME, ACTIONS], rng) for _ in range(N_FRAMES)]
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        thread = threading.Thread(target=answer_each, args=[listening, frames], daemon=True)
        thread.start()
        statuses = []
        with CClient(built, f"unix://{tmp_path}/s") as client:
            for turn in range(len(frames)):
                if turn:
                    client.connect()
                client.hello()
                try:
                    client.turn("query", BOTS, 7, free=FREE)
                    statuses.append("OK")
                except Refused as refusal:
                    statuses.append(refusal.status)
        thread.join()
    assert set(statuses) == {"OK", "BAD_REPLY", "CLOSED"}


def answer_each(listening: socket.socket, frames: list[bytes]) -> None:
    for frame in frames:
        accepted, _ = listening.accept()
        with accepted:
            for reply in (WELCOME, frame):
                accepted.recv(65536)
                accepted.sendall(reply)


def test_a_server_that_is_gone_raises_no_signal(built: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        with CClient(built, f"unix://{tmp_path}/s") as client:
            accepted, _ = listening.accept()
            with accepted:
                accepted.sendall(WELCOME)
                client.hello()
            with pytest.raises(Refused, match="CLOSED"):
                client.turn("query", BOTS, 7, free=FREE)
