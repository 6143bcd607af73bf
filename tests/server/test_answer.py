"""What fails inside the server is answered, logged, and never shown."""

from __future__ import annotations

import json
import logging
import time
from types import SimpleNamespace
from typing import Any

import pytest

from bot_runtime.work import Steps
from protocol.client import BotClient
from protocol.codec import MAX_DETAIL_CHARS, Format
from protocol.errors import TooManyBots
from server import desk
from server.answer import Answer, Arrival, answer, refusal, steps
from server.recorder import Recorder
from tests.server.serving import Served


def _failing(*_: object) -> None:
    raise RuntimeError("secret /path")


def test_a_failure_is_internal_and_its_traceback_stays_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    recorder = Recorder()
    handlers = SimpleNamespace(steps=_failing, recorder=recorder)
    with caplog.at_level(logging.ERROR):
        answered = answer(handlers, b'{"type":"goodbye"}', Format.JSON, None, Arrival.now("tcp"))
    assert (answered.status, json.loads(answered.body)["code"]) == (500, "INTERNAL")
    assert b"secret" not in answered.body
    assert "secret /path" in caplog.text
    assert (recorder.answers, recorder.refusals) == ({}, {("tcp", "INTERNAL"): 1})


def test_a_refusal_is_bounded_and_says_when_to_try_again() -> None:
    answered = refusal(TooManyBots("x" * 1000, retry_after_s=2.0), Format.JSON)
    said = json.loads(answered.body)
    assert (answered.status, said["retry_after_s"], len(said["detail"])) == (429, 2.0, MAX_DETAIL_CHARS)


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_every_request_says_by_which_door_and_when_it_came(
    served: Served, door: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrivals: list[Arrival] = []

    def noted(
        handlers: object, body: bytes, form: Format, connection: str | None, arrival: Arrival, **how: Any
    ) -> Steps[Answer]:
        arrivals.append(arrival)
        return (yield from steps(handlers, body, form, connection, arrival, **how))

    monkeypatch.setattr(desk, "steps", noted)
    begun_ns = time.monotonic_ns()
    with BotClient(served.addresses[door]) as client:
        client.hello()
        client.stop(client.start(2))
    assert [arrival.transport for arrival in arrivals] == [door] * 4
    times_ns = [begun_ns, *(arrival.received_ns for arrival in arrivals), time.monotonic_ns()]
    assert times_ns == sorted(times_ns)
