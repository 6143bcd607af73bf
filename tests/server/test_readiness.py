"""Readiness: each check by name, and what /readyz says of a real server whose worker is stuck, and of one that ends."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

from server.readiness import Readiness
from server.worker import Worker
from tests.protocol.golden import VECTORS
from tests.server.serving import FakeClock, RawStream, http_request, serve
from tests.server.test_busy import Gate


def test_it_names_the_checks_that_fail() -> None:
    readiness, failing = Readiness(), {"disk": "full", "worker": None}
    for name in failing:
        readiness.register(name, lambda name=name: failing[name])
    assert (readiness.names, readiness.failing()) == (("drain", "disk", "worker"), {"disk": "full"})
    readiness.is_draining = True
    assert set(readiness.failing()) == {"drain", "disk"}
    with pytest.raises(ValueError, match="'disk'"):
        readiness.register("disk", lambda: None)


def test_a_worker_is_busy_for_as_long_as_its_job_runs() -> None:
    clock, begun, release, over = FakeClock(), threading.Event(), threading.Event(), threading.Event()
    worker = Worker(1, clock)
    try:
        assert worker.busy_s() == 0.0
        worker.post(lambda: (begun.set(), release.wait()))
        worker.post(over.set)
        begun.wait()
        clock.now += 7.0
        assert worker.busy_s() == 7.0
    finally:
        release.set()
        over.wait()
        worker.close()
    assert worker.busy_s() == 0.0


def test_a_stuck_worker_is_not_ready_and_the_probes_go_on(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, clock = Gate(monkeypatch), FakeClock()
    monkeypatch.setattr("server.app.Worker", lambda max_queue: Worker(max_queue, clock))
    with serve(bundle, tmp_path / "s") as served, RawStream(served.addresses["tcp"]) as waiting:
        http = served.addresses["http"]
        ready = http_request(http, "GET", "/readyz")
        checks = {"drain": "ok", "bundle": "ok", "breaker": "ok", "worker": "ok"}
        assert (ready.status, json.loads(ready.body)) == (200, {"status": "ready", "checks": checks})
        try:
            waiting.socket.sendall(VECTORS["hello"].frame)
            gate.reached.wait()
            clock.now += 60.0
            stuck = http_request(http, "GET", "/readyz")
            body = json.loads(stuck.body)
            assert (stuck.status, stuck.headers["retry-after"], body["code"]) == (503, "1", "NOT_READY")
            assert [name for name, said in body["checks"].items() if said != "ok"] == ["worker"]
            assert "worker" in body["detail"]
            assert "60.0 s" in body["detail"]
            metrics = http_request(http, "GET", "/metrics").body.decode()
            assert 'bot_runtime_ready_check{check="worker"} 0.0' in metrics
            assert "bot_runtime_worker_busy_seconds 60.0" in metrics
            assert http_request(http, "GET", "/healthz").status == 200
        finally:
            gate.opened.set()
        assert waiting.reply()["type"] == "welcome"
        assert http_request(http, "GET", "/readyz").status == 200
