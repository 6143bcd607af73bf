"""What fails inside the server is answered, logged, and never shown."""

from __future__ import annotations

import json
import logging
from types import SimpleNamespace

import pytest

from protocol.codec import MAX_DETAIL_CHARS, Format
from protocol.errors import TooManyBots
from server.answer import answer, refusal


def _failing(*_: object) -> None:
    raise RuntimeError("secret /path")


def test_a_failure_is_internal_and_its_traceback_stays_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        answered = answer(SimpleNamespace(handle=_failing), b'{"type":"goodbye"}', Format.JSON, None)
    assert (answered.status, json.loads(answered.body)["code"]) == (500, "INTERNAL")
    assert b"secret" not in answered.body
    assert "secret /path" in caplog.text


def test_a_refusal_is_bounded_and_says_when_to_try_again() -> None:
    answered = refusal(TooManyBots("x" * 1000, retry_after_s=2.0), Format.JSON)
    said = json.loads(answered.body)
    assert (answered.status, said["retry_after_s"], len(said["detail"])) == (429, 2.0, MAX_DETAIL_CHARS)
