from __future__ import annotations

import asyncio
import socket
from pathlib import Path
from typing import Any

import pytest

from protocol.errors import BadBundle
from server import app
from server.app import running
from server.listening import listen_tcp
from server.observation import Observation, watch
from server.settings import Settings
from server.sockets import Sockets


def test_http_and_tcp_listen_on_such_sockets(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[int] = []

    def listen(host: str, port: int) -> socket.socket:
        listening = listen_tcp(host, port)
        ports.append(listening.getsockname()[1])
        return listening

    monkeypatch.setattr(app, "listen_tcp", listen)

    async def main() -> list[int]:
        async with running(Settings(bundle=bundle, port=0, tcp_port=0)) as addresses:
            return [int(addresses[door].rpartition(":")[2]) for door in ("http", "tcp")]

    assert asyncio.run(main()) == ports


def test_a_server_that_ends_is_not_ready_before_it_drains(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    observed: list[Observation] = []
    failing_when_draining: list[dict[str, str]] = []

    def remember(*parts: Any) -> Observation:
        observed.append(watch(*parts))
        return observed[0]

    async def drain(*_: object) -> None:
        failing_when_draining.append(observed[0].readiness.failing())

    monkeypatch.setattr(app, "watch", remember)
    monkeypatch.setattr(Sockets, "drain", drain)

    async def main() -> None:
        async with running(Settings(bundle=bundle, port=0)):
            assert observed[0].readiness.failing() == {}

    asyncio.run(main())
    assert [list(failing) for failing in failing_when_draining] == [["drain"]]


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
