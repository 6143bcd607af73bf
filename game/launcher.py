"""A server of one's own: started as a process, waited for, and stopped with whoever started it.

This module knows nothing about what is served, or how to talk to it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self

__all__ = ["ServerFailed", "ServerProcess", "end"]

_START_S = 60.0
_STOP_S = 10.0
"""The server drains for 5 s at most; it is killed after this."""
_POLL_S = 0.02
_TAIL_LINES = 15
_SERVE_UNTIL_PARENT_DIES = """
import ctypes, os, runpy, signal, sys
PR_SET_PDEATHSIG = 1
ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
if os.getppid() != int(sys.argv.pop(1)):
    sys.exit("the parent died before it could be watched")
runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
"""


class ServerFailed(Exception):
    """The server did not start, or has ended; the message carries the end of what it printed."""


def end(process: subprocess.Popen[bytes]) -> None:
    """Ask a process to end, and see to it that it has."""
    process.terminate()
    try:
        process.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class ServerProcess:
    """`python -m server` on a free port of this machine and a Unix socket, for as long as the `with` block lasts.

    It runs in a session of its own, so that Ctrl-C reaches only this process, which then stops it. On Linux the kernel
    sends it SIGTERM when this process dies in any way, kill -9 included; elsewhere kill -9 leaves it running.
    """

    def __init__(self, bundle: Path | None, *arguments: str, module: str = "server") -> None:
        """`arguments` go to the server's command line as they are, and say what is served where `bundle` is None.

        `module` is what is run, with that command line.
        """
        self._bundle, self._arguments, self._module = bundle, arguments, module

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory(prefix="bots-")
        self._ready_file = Path(self._folder.name) / "ready.json"
        self._log = Path(self._folder.name) / "server.log"
        command = [
            *_command(self._module), *(() if self._bundle is None else ("--bundle", str(self._bundle))), "--port", "0",
            "--uds", str(self._ready_file.with_name("s")), "--ready-file", str(self._ready_file), *self._arguments,
        ]  # fmt: skip
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        end(self._process)
        self._folder.cleanup()

    @property
    def pid(self) -> int:
        """The server's process."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process has ended, which it should not have."""
        return self._process.poll() is not None

    def addresses(self) -> dict[str, str]:
        """Where it listens, by door: `http`, `unix`, and `tcp` if asked for.

        Waits until it does; raises ServerFailed if it never will.
        """
        deadline = time.monotonic() + _START_S
        while not self._ready_file.exists():
            if self.ended:
                raise ServerFailed(f"the server ended with exit code {self._process.returncode}:\n{self.tail()}")
            if time.monotonic() > deadline:
                raise ServerFailed(f"the server was not ready after {_START_S:g} s:\n{self.tail()}")
            time.sleep(_POLL_S)
        found = json.loads(self._ready_file.read_text(encoding="utf-8"))
        return {door: url for door, url in found.items() if door != "pid" and url is not None}

    def tail(self) -> str:
        """The last lines that the server printed."""
        return "\n".join(self._log.read_text(encoding="utf-8", errors="replace").splitlines()[-_TAIL_LINES:])


def _command(module: str) -> list[str]:
    """`python -m MODULE`, on Linux by way of asking the kernel for SIGTERM at the parent's death (prctl(2)).

    The child asks for itself: code between fork and exec (`preexec_fn`) may deadlock when the parent has threads.
    """
    if not sys.platform.startswith("linux"):
        return [sys.executable, "-m", module]
    return [sys.executable, "-c", _SERVE_UNTIL_PARENT_DIES, str(os.getpid()), module]
