"""`python -m server --bundle bundles/hard` or `--store FOLDER`: serve until SIGTERM or Ctrl-C, drain, exit with 0.

This module knows nothing about what is served.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import signal
import sys
from pathlib import Path

import tyro
import uvloop

from protocol.errors import ProtocolError
from server.app import running
from server.aside import Aside
from server.logs import configure, logger
from server.settings import Settings

__all__ = ["main"]

_log = logger("server")


async def _serve(settings: Settings) -> None:
    stop = asyncio.Event()
    for signal_number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(signal_number, stop.set)
    async with running(settings) as addresses:
        gc.freeze()  # what is there by now stays: no later collection walks it, which would take tens of ms
        _log.info("serving", **addresses)
        try:
            if settings.ready_file is not None:
                _write(settings.ready_file, {**addresses, "pid": os.getpid()})
            await stop.wait()
        finally:
            if settings.ready_file is not None and _is_ours(settings.ready_file):
                settings.ready_file.unlink(missing_ok=True)
        _log.info("draining")


def _write(path: Path, content: dict[str, str | int]) -> None:
    """Whole or not at all: whoever waits for the file must never read half of it."""
    unfinished = path.with_name(f"{path.name}.{os.getpid()}")
    unfinished.write_text(json.dumps(content) + "\n", encoding="utf-8")
    unfinished.replace(path)


def _is_ours(path: Path) -> bool:
    """Whether no other server has written its own there since."""
    try:
        return bool(json.loads(path.read_bytes())["pid"] == os.getpid())
    except (OSError, ValueError, LookupError, TypeError):
        return False


def main() -> None:
    """Parse the command line and serve. Exits with 2 for settings or a bundle that cannot be served."""
    descriptor = os.open(os.devnull, os.O_WRONLY) if sys.stderr is None else sys.stderr.fileno()
    with Aside(descriptor) as stream:
        configure(None, stream)
        try:
            settings = tyro.cli(Settings, description="Serve bundles to game engines.")
            configure(settings.log_json, stream)
            uvloop.run(_serve(settings))
        except (ValueError, OverflowError, MemoryError, ProtocolError, OSError) as error:
            _log.error(str(error))
            sys.exit(2)


if __name__ == "__main__":
    main()
