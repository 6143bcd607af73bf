"""What the doors do while the worker is busy: the loop goes on, the queue is bounded, and stopping waits."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from bot_runtime.work import Steps
from server import desk
from server.answer import Answer, steps
from server.sockets import Sockets
from tests.protocol.golden import VECTORS
from tests.server.serving import RawStream, http_request, serve

HELLO = VECTORS["hello"]


class Gate:
    """Holds up every request, hellos on the worker's thread, until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.opened = threading.Event(), threading.Event()
        monkeypatch.setattr(desk, "steps", self._steps)

    def _steps(self, *arguments: object, **how: object) -> Steps[Answer]:
        self.reached.set()
        self.opened.wait()
        return (yield from steps(*arguments, **how))


def test_a_full_queue_refuses_at_once_at_every_door(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate(monkeypatch)
    with (
        serve(bundle, tmp_path / "s", max_queue=1) as served,
        RawStream(served.addresses["tcp"]) as waiting,
        RawStream(served.addresses["unix"]) as refused,
    ):
        try:
            waiting.socket.sendall(HELLO.frame)
            gate.reached.wait()
            assert refused.frame(HELLO.body)["code"] == "NOT_READY"
            http, headers = served.addresses["http"], {"Content-Type": "application/json"}
            answered = http_request(http, "POST", "/v1/connections", b"{}", headers)
            assert (answered.status, answered.headers["retry-after"]) == (503, "1")
            assert http_request(http, "GET", "/healthz").status == 200
        finally:
            gate.opened.set()
        assert waiting.reply()["type"] == "welcome"
        assert refused.frame(HELLO.body)["type"] == "welcome"


def test_stopping_answers_the_request_in_progress(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, drain, draining = Gate(monkeypatch), Sockets.drain, threading.Event()

    async def announced(self: Sockets, timeout_s: float) -> None:
        draining.set()
        await drain(self, timeout_s)

    monkeypatch.setattr(Sockets, "drain", announced)
    with serve(bundle, tmp_path / "s") as served, RawStream(served.addresses["tcp"]) as raw:
        raw.socket.sendall(HELLO.frame)
        gate.reached.wait()
        stopping = threading.Thread(target=served.stop)
        stopping.start()
        draining.wait()
        gate.opened.set()
        assert raw.reply()["type"] == "welcome"
        assert raw.ended()
        stopping.join()
