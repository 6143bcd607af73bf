"""Logs: readable by machines, silent about secrets and frames, and not to be flooded."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.client import BotClient
from protocol.errors import Unauthorized
from server.logs import Flood, configure, digest, logger
from tests.protocol.golden import TABLE
from tests.server.serving import FakeClock, play, serve


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    """Where the root logger writes to, until the test ends."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    root.handlers[:] = []  # else `configure` would close pytest's own
    yield io.StringIO()
    root.handlers[:] = handlers
    root.setLevel(level)


def lines(stream: io.StringIO) -> list[dict]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_a_line_is_json_with_its_values_and_its_traceback(stream: io.StringIO) -> None:
    configure(None, stream)
    logger("server.test").info("bundle loaded", bundle="hard", version=3)
    logging.getLogger("elsewhere").warning("%d things", 7, extra={"transport": "tcp"})
    try:
        raise RuntimeError("why")
    except RuntimeError:
        logger("server.test").exception("a request failed")
    logger("server.test").debug("not said")
    loaded, things, failed = lines(stream)
    assert loaded.pop("timestamp").endswith("Z")
    assert loaded == {
        "event": "bundle loaded",
        "level": "info",
        "logger": "server.test",
        "bundle": "hard",
        "version": 3,
    }
    assert (things["event"], things["level"], things["transport"]) == ("7 things", "warning", "tcp")
    assert "RuntimeError: why" in failed["exception"]


def test_a_person_gets_text(stream: io.StringIO) -> None:
    configure(False, stream)
    logger("server.test").warning("breaker open", bundle="hard")
    said = stream.getvalue()
    assert "breaker open" in said
    assert "bundle=hard" in said
    assert not said.startswith("{")


def test_a_flood_is_cut_and_counted() -> None:
    clock = FakeClock()
    flood, passed = Flood(limit=3, window_s=10.0, clock=clock), []
    for _ in range(50):
        record = logging.makeLogRecord({"name": "a", "msg": "hello refused"})
        if flood.filter(record):
            passed.append(record)
        assert flood.filter(logging.makeLogRecord({"name": "a", "msg": str(clock.now)}))  # another event
        clock.now += 0.3  # 15 s in all
    assert [getattr(record, "suppressed", 0) for record in passed] == [0, 0, 0, 31, 0, 0]


def test_events_that_never_repeat_need_no_memory() -> None:
    flood = Flood()
    assert all(flood.filter(logging.makeLogRecord({"name": "a", "msg": str(i)})) for i in range(2000))
    assert len(flood._windows) == 256


@pytest.mark.parametrize("door", ["http", "tcp"])
def test_a_connection_is_two_lines_and_no_secrets(bundle: Path, tmp_path: Path, stream: io.StringIO, door: str) -> None:
    configure(True, stream)
    with serve(bundle, tmp_path / "s", token="s3cret") as server:
        with BotClient(server.addresses[door]) as client:
            connection = client.hello(token="s3cret").connection
            play(client, TABLE, client.start(2), range(30))
        with BotClient(server.addresses[door]) as client, pytest.raises(Unauthorized):
            client.hello(token="guess")
    said = lines(stream)
    assert [line["event"] for line in said] == [
        "bundle active",
        "connection opened",
        "connection ended",
        "hello refused",
    ]
    opened, ended, refused = said[1:]
    assert opened["connection"] == ended["connection"] == digest(connection)
    assert (opened["transport"], opened["bundle"], ended["bots"]) == (door, "tiny", 2)
    assert (refused["transport"], refused["code"]) == (door, "UNAUTHORIZED")
    assert not any(secret in stream.getvalue() for secret in (connection, "s3cret", "guess"))
