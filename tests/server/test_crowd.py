"""One socket too many at the HTTP port, and that every way of closing one makes room again."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from protocol.client import BotClient
from protocol.errors import TooManyConnections
from server.crowd import Crowd
from server.settings import Settings
from tests.server.serving import RawStream, Served, serve
from tests.server.test_metrics import Scrape

HEALTH = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
UPGRADE = b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
HANDSHAKE = b"GET %s HTTP/1.1\r\nHost: x\r\n" + UPGRADE + b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
WAIT_S = 30.0


def _asked(served: Served, request: bytes, stack: ExitStack) -> bytes:
    """The status line of the answer on a socket of its own, which stays open."""
    raw = stack.enter_context(RawStream(served.addresses["http"]))
    try:
        raw.socket.sendall(request)
        return raw.socket.recv(4096).partition(b"\r\n")[0]
    except ConnectionError:  # it was closed before it was asked
        return b""


def _until(is_so: Callable[[], bool]) -> None:
    given_up_s = time.monotonic() + WAIT_S
    while not is_so():
        assert time.monotonic() < given_up_s
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("held", "answer"),
    [
        (HEALTH, b"HTTP/1.1 200 OK"),
        (HEALTH[:-1], None),
        (HANDSHAKE % b"/v1/socket", b"HTTP/1.1 101 Switching Protocols"),
        (HANDSHAKE % b"/nowhere", b"HTTP/1.1 404 Not Found"),
    ],
)
def test_every_open_socket_of_the_port_counts_until_it_closes(
    bundle: Path, tmp_path: Path, held: bytes, answer: bytes | None
) -> None:
    with serve(bundle, tmp_path / "s", max_http_sockets=2, frame_deadline_s=WAIT_S) as served:
        with ExitStack() as holding:
            for _ in range(2):
                if answer is None:
                    holding.enter_context(RawStream(served.addresses["http"])).socket.sendall(held)
                else:
                    assert _asked(served, held, holding) == answer
            with ExitStack() as refused:
                raw = refused.enter_context(RawStream(served.addresses["http"]))
                answered = raw.socket.recv(4096)  # before anything is asked
                assert answered.startswith(b"HTTP/1.1 503 Service Unavailable\r\n")
                assert b"TOO_MANY_CONNECTIONS" in answered
                assert raw.ended()
        with ExitStack() as stack:
            _until(lambda: _asked(served, HEALTH, stack) == b"HTTP/1.1 200 OK")


def test_an_engine_is_told_what_is_the_matter_and_it_is_counted(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", max_http_sockets=1) as served:
        with BotClient(served.addresses["http"]) as first, BotClient(served.addresses["http"]) as second:
            first.hello()
            with pytest.raises((TooManyConnections, ConnectionError)):
                second.hello()
        with ExitStack() as stack:
            _until(lambda: _asked(served, HEALTH, stack) == b"HTTP/1.1 200 OK")
            stack.close()
            scraped: list[Scrape] = []

            def scrape() -> bool:
                try:
                    scraped.append(Scrape(served))
                except (AssertionError, OSError):
                    return False
                return True

            _until(scrape)
        assert scraped[-1]("sockets", transport="http") == 1
        assert scraped[-1]("http_sockets_limit") == 1
        assert scraped[-1]("refused_total", transport="http", code="TOO_MANY_CONNECTIONS") >= 1


def test_there_are_four_sockets_a_connection_unless_said_otherwise() -> None:
    assert Settings(bundle=Path("b"), max_connections=5).http_sockets == 20
    assert Settings(bundle=Path("b"), max_connections=5, max_http_sockets=7).http_sockets == 7
    with pytest.raises(ValueError, match="max_http_sockets"):
        Settings(bundle=Path("b"), max_http_sockets=0)


def test_one_that_was_turned_away_takes_no_place() -> None:
    crowd = Crowd(1)
    crowd.enter()
    for _ in range(3):
        with pytest.raises(TooManyConnections):
            crowd.enter()
    crowd.leave()
    crowd.enter()
    assert len(crowd) == 1
