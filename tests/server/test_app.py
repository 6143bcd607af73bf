from __future__ import annotations

import asyncio
import json
import socket
from pathlib import Path
from typing import Any

import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.errors import BadBundle
from server.app import _listen, running
from server.connections import Connections
from server.handlers import Handlers
from server.http import HttpDoor, create_app
from server.settings import Settings
from server.worker import Worker


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_listening_sockets_say_that_they_are_tcp(host: str) -> None:
    """asyncio turns Nagle's algorithm off only for sockets accepted from such."""
    with _listen(host, 0) as listening:
        assert listening.proto == socket.IPPROTO_TCP


def test_a_draining_door_is_alive_and_not_ready(bundle: Path) -> None:
    worker = Worker(1)
    bots = Bots(Bundle.load(bundle), max_bots=1)
    door = HttpDoor(Handlers(bots, Connections(1, 1.0), None), worker, bots.bundle.manifest, body_deadline_s=1.0)
    app = create_app(door)

    def get(path: str) -> tuple[int, dict[str, Any]]:
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        scope = {"type": "http", "method": "GET", "path": path, "headers": [], "query_string": b"", "root_path": ""}
        asyncio.run(app(scope, receive, send))
        return sent[0]["status"], json.loads(sent[1]["body"])

    try:
        assert get("/readyz") == (200, {"status": "ready"})
        door.ready = False
        status, refused = get("/readyz")
        assert (status, refused["code"]) == (503, "NOT_READY")
        assert get("/healthz") == (200, {"status": "ok"})
    finally:
        worker.close()


def test_a_server_that_cannot_start_leaves_nothing_behind(bundle: Path, tmp_path: Path) -> None:
    async def start(settings: Settings) -> None:
        async with running(settings):
            pytest.fail("it started")

    taken = tmp_path / "file"
    taken.write_text("mine")
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for settings in (
            Settings(bundle=bundle, port=port),
            Settings(bundle=bundle, port=0, tcp_port=port),
            Settings(bundle=bundle, port=0, uds=taken),
        ):
            with pytest.raises(OSError, match=r"in use|not a socket"):
                asyncio.run(start(settings))
    with pytest.raises(BadBundle):
        asyncio.run(start(Settings(bundle=tmp_path, port=0)))
    assert taken.read_text() == "mine"
