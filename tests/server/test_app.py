from __future__ import annotations

import asyncio
import json
import socket
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from bot_runtime.bundle import Bundle
from protocol.errors import BadBundle
from server import app
from server.app import _listen, running
from server.connections import Connections
from server.desk import Desk
from server.handlers import Handlers
from server.http import HttpDoor, create_app
from server.serving import Serving
from server.servings import Servings
from server.settings import Settings
from server.sockets import Sockets
from server.worker import Worker


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_listening_sockets_say_that_they_are_tcp(host: str) -> None:
    """asyncio turns Nagle's algorithm off only for sockets accepted from such."""
    with _listen(host, 0) as listening:
        assert listening.proto == socket.IPPROTO_TCP


def test_http_and_tcp_listen_on_such_sockets(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[int] = []

    def listen(host: str, port: int) -> socket.socket:
        listening = _listen(host, port)
        ports.append(listening.getsockname()[1])
        return listening

    monkeypatch.setattr(app, "_listen", listen)

    async def main() -> list[int]:
        async with running(Settings(bundle=bundle, port=0, tcp_port=0)) as addresses:
            return [int(addresses[door].rpartition(":")[2]) for door in ("http", "tcp")]

    assert asyncio.run(main()) == ports


def test_a_draining_door_is_alive_and_not_ready(bundle: Path) -> None:
    worker = Worker(1)
    servings = Servings(max_bots=1)
    servings.activate(Serving(Bundle.load(bundle), max_bots=1))
    handlers = Handlers(servings, Connections(1, 1.0), None)
    door = HttpDoor(Desk(handlers, worker, inline_us=0.0), worker, body_deadline_s=1.0)
    application = create_app(door)

    def get(path: str) -> tuple[int, dict[str, Any], dict[bytes, bytes]]:
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        scope = {"type": "http", "method": "GET", "path": path, "headers": [], "query_string": b"", "root_path": ""}
        asyncio.run(application(scope, receive, send))
        return sent[0]["status"], json.loads(sent[1]["body"]), dict(sent[0]["headers"])

    try:
        assert get("/readyz")[:2] == (200, {"status": "ready"})
        door.ready = False
        status, refused, headers = get("/readyz")
        assert (status, refused["code"], headers[b"retry-after"]) == (503, "NOT_READY", b"1")
        assert get("/healthz")[:2] == (200, {"status": "ok"})
    finally:
        worker.close()


def test_a_server_that_ends_is_not_ready_before_it_drains(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    doors: list[HttpDoor] = []
    ready_when_draining: list[bool] = []

    def remember(door: HttpDoor) -> FastAPI:
        doors.append(door)
        return create_app(door)

    async def drain(*_: object) -> None:
        ready_when_draining.append(doors[0].ready)

    monkeypatch.setattr(app, "create_app", remember)
    monkeypatch.setattr(Sockets, "drain", drain)

    async def main() -> None:
        async with running(Settings(bundle=bundle, port=0)):
            assert doors[0].ready

    asyncio.run(main())
    assert ready_when_draining == [False]


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
