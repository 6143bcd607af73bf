"""HAProxy before several server processes, as docker/haproxy/haproxy.cfg has it.

This module knows nothing about what the servers serve. It needs `haproxy` on the path.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

from game.launcher import end

__all__ = ["CONFIG", "Front", "FrontFailed", "configured"]

CONFIG = Path(__file__).parent.parent / "docker" / "haproxy" / "haproxy.cfg"
_HOST = "127.0.0.1"
_START_S = 60.0
_PATIENT = "    timeout connect 60s\n    timeout check 60s"  # a process that is slow is not dead: that one refuses
_POLL_S = 0.02


class FrontFailed(Exception):
    """HAProxy is not installed or did not start; the message says which."""


class Front:
    """HAProxy on free ports of loopback for as long as the `with` block lasts; `http` and `tcp` are where it listens.

    `servers` are the addresses of each process, named p1, p2 and so on in this order. One that `is_patient` waits a
    minute for their answers to its checks: on a machine that is busy with other things they are late, not gone.
    """

    def __init__(self, servers: Sequence[dict[str, str]], *, is_patient: bool = False) -> None:
        self._servers = servers
        self._is_patient = is_patient
        self.http, self.tcp = "", ""

    def __enter__(self) -> Self:
        if (found := shutil.which("haproxy")) is None:
            raise FrontFailed("haproxy is not installed")
        http, tcp = _free_ports(2)
        self.http, self.tcp = f"http://{_HOST}:{http}", f"tcp://{_HOST}:{tcp}"
        self._folder = tempfile.TemporaryDirectory(prefix="front-")
        path = Path(self._folder.name) / "haproxy.cfg"
        shipped = CONFIG.read_text(encoding="utf-8")
        if self._is_patient:
            shipped = shipped.replace("    timeout connect 1s", _PATIENT)
        path.write_text(configured(shipped, self._servers, http, tcp), encoding="utf-8")
        # -db: in the foreground, so that it ends with this process's signals and not after them.
        self._process = subprocess.Popen([found, "-db", "-f", str(path)], stdin=subprocess.DEVNULL)
        try:
            for port in (http, tcp):
                self._wait_for(port)
        except FrontFailed:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        end(self._process)
        self._folder.cleanup()

    def _wait_for(self, port: int) -> None:
        deadline = time.monotonic() + _START_S
        while time.monotonic() < deadline and self._process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex((_HOST, port)) == 0:
                    return
            time.sleep(_POLL_S)
        raise FrontFailed(f"HAProxy does not listen on {_HOST}:{port}; it says why above")


def configured(text: str, servers: Sequence[dict[str, str]], http: int, tcp: int) -> str:
    """The configuration `text` with these servers in place of its own, on these ports; all else as it is."""
    ports = [{door: urlsplit(url).port for door, url in server.items()} for server in servers]
    listening, section, lines, done = {"http": http, "stream": tcp}, "", list[str](), set[str]()
    for line in text.splitlines():
        words = line.split()
        if words and not line.startswith((" ", "#")):
            section = words[-1]
        if words[:1] == ["bind"]:
            lines.append(f"    bind {_HOST}:{listening[section]}")
        elif words[:1] != ["server"]:
            lines.append(line)
        elif section not in done:
            done.add(section)
            for number, port in enumerate(ports, 1):
                at = f"{_HOST}:{port['http']}" if section == "http" else f"{_HOST}:{port['tcp']} port {port['http']}"
                lines.append(f"    server p{number} {at}")
    return "\n".join([*lines, ""])


def _free_ports(count: int) -> list[int]:
    """Ports that nothing listens on now. If somebody is quicker than HAProxy, it says so and does not start."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for unused in sockets:
            unused.bind((_HOST, 0))
        return [unused.getsockname()[1] for unused in sockets]
