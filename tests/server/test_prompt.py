"""Slow clients of the HTTP door. Deadlines are short here, and what is waited for is the server's close."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import uvicorn
import uvloop
from uvicorn.server import ServerState

from server.crowd import Crowd
from server.prompt import PromptHttp
from server.recorder import Recorder
from tests.server.serving import RawStream, Served, serve

PATIENCE = {"deadline_s": 0.2, "crowd": Crowd(9), "recorder": Recorder()}
REQUEST = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.fixture(scope="module")
def hasty(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with serve(bundle, tmp_path_factory.mktemp("hasty") / "s", frame_deadline_s=0.2, idle_ttl_s=30.0) as running:
        yield running


def _open(served: Served) -> RawStream:
    return RawStream(served.addresses["http"])


def _flood(raw: socket.socket, data: bytes) -> None:
    for _ in range(10**5):
        raw.sendall(data)


def _answered(raw: RawStream) -> bytes:
    raw.socket.sendall(REQUEST)
    return _read_answer(raw)


def _read_answer(raw: RawStream) -> bytes:
    answer = b""
    while b'{"status":"ok"}' not in answer:
        answer += raw.socket.recv(4096)
    return answer


@pytest.mark.parametrize("sent", [b"", b"\r\n", b"G", b"GET / HTTP/1.1\r\n", REQUEST[:-1]])
def test_a_socket_that_does_not_send_a_whole_head_in_time_is_closed(hasty: Served, sent: bytes) -> None:
    with _open(hasty) as raw:
        raw.socket.sendall(sent)
        assert raw.ended()


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("drop", [b"x", b"\r\n"])
def test_a_head_that_comes_byte_by_byte_does_not_put_off_the_end(hasty: Served, first: bool, drop: bytes) -> None:
    """On a new socket, and on one that has been answered: empty lines between requests are not even a head."""
    with _open(hasty) as raw:
        if not first:
            assert b" 200 " in _answered(raw)
        raw.socket.settimeout(0.02)
        give_up = time.monotonic() + 10.0
        while time.monotonic() < give_up:
            try:
                raw.socket.sendall(drop)
                if raw.socket.recv(1) == b"":
                    return
            except TimeoutError:
                continue
            except ConnectionError:
                return
        pytest.fail("it stayed open")


def test_a_head_without_an_end_is_cut_off(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s") as served, _open(served) as raw:
        raw.socket.sendall(b"GET / HTTP/1.1\r\nA: ")
        with pytest.raises(ConnectionError):
            _flood(raw.socket, b"a" * 4096)


def test_a_socket_that_was_answered_may_be_silent(hasty: Served) -> None:
    with _open(hasty) as idle, _open(hasty) as slow:
        assert b" 200 " in _answered(idle)
        assert slow.ended()  # a whole deadline later
        assert b" 200 " in _answered(idle)


def test_pipelined_requests_are_all_answered(hasty: Served) -> None:
    with _open(hasty) as raw:
        raw.socket.sendall(REQUEST * 3)
        answers = b""
        while answers.count(b'{"status":"ok"}') < 3:
            answers += raw.socket.recv(4096)
        assert answers.count(b"HTTP/1.1 200") == 3


def test_a_client_that_does_not_read_its_answers_is_closed(caplog: pytest.LogCaptureFixture) -> None:
    """Neither the answer in progress nor the pipelined one behind it fails over the closed socket."""
    ended: list[int] = []

    async def large(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(64):
            await send({"type": "http.response.body", "body": bytes(2**20), "more_body": True})
        await send({"type": "http.response.body", "body": b""})
        ended.append(1)

    async def main() -> None:
        closed = asyncio.Event()

        class Watched(PromptHttp):
            def connection_lost(self, exc: Exception | None) -> None:
                super().connection_lost(exc)
                closed.set()

        config = uvicorn.Config(large, log_config=None, lifespan="off", ws="none")
        state = ServerState()
        protocol = partial(Watched, config=config, server_state=state, app_state={}, **PATIENCE)
        server = await asyncio.get_running_loop().create_server(protocol, "127.0.0.1", 0)
        with socket.create_connection(server.sockets[0].getsockname()) as deaf:
            deaf.sendall(REQUEST * 2)
            async with asyncio.timeout(20):
                await closed.wait()
        await asyncio.gather(*state.tasks)
        server.close()

    uvloop.run(main())
    assert ended
    assert not caplog.records
