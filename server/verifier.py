"""Verification in a process of its own: `python -m server.verifier FOLDER [KEY ...]`.

This module knows nothing about what a verified bundle is for. A graph that takes onnxruntime down, all memory or
forever takes this process, not the server; and no frame waits for it. It prints one line of JSON, a `Verdict`.
"""

from __future__ import annotations

import asyncio
import os
import resource
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import msgspec

from bot_runtime.bundle import Bundle
from bot_runtime.signature import Keys
from protocol.errors import BadBundle

__all__ = ["TIMEOUT_S", "verify"]

TIMEOUT_S = 120.0  # also where the machine is busy
_MAX_MEMORY_BYTES = 8 * 2**30  # of addresses, most of which are never touched
_MAX_CPU_S = 60
_MAX_DETAIL_CHARS = 300
_NICENESS = 5  # frames go first


class Verdict(msgspec.Struct, forbid_unknown_fields=True):
    """The hash of the content that passed, or what was wrong with it."""

    sha256: str | None = None
    problem: str | None = None


async def verify(folder: Path, keys: Sequence[Path] = (), *, timeout_s: float = TIMEOUT_S) -> str:
    """The SHA-256 of the manifest of the bundle in `folder`, all of which is verified. Raises BadBundle, OSError."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "server.verifier", str(folder.absolute()), *(str(key.absolute()) for key in keys)),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )
    try:
        async with asyncio.timeout(timeout_s):
            output, _ = await process.communicate()
    except TimeoutError:
        raise BadBundle(f"verifying took more than {timeout_s:g} s") from None
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    try:
        verdict = msgspec.json.decode(output, type=Verdict)
    except msgspec.DecodeError:
        raise BadBundle(f"verifying it ended the process with {process.returncode}") from None
    if verdict.sha256 is None:
        raise BadBundle(verdict.problem or "it does not verify")
    return verdict.sha256


def _verdict(folder: Path, keys: Sequence[Path]) -> Verdict:
    try:
        # By processor time: how long a turn takes must not depend on what else runs here meanwhile.
        bundle = Bundle.load(folder, keys=Keys.read(keys) if keys else None, clock=time.process_time_ns)
        return Verdict(sha256=bundle.sha256)
    except BadBundle as error:
        return Verdict(problem=error.detail[:_MAX_DETAIL_CHARS])


def main() -> None:
    """Print the verdict on the bundle that the command line names."""
    os.nice(_NICENESS)
    resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (_MAX_CPU_S, _MAX_CPU_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    folder, *keys = map(Path, sys.argv[1:])
    print(msgspec.json.encode(_verdict(folder, keys)).decode())


if __name__ == "__main__":
    main()
