"""Verification in a process of its own: what it says, and that nothing which happens there happens here."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from bot_runtime.bundle import Bundle
from protocol.errors import BadBundle
from server.verifier import verify


def test_a_bundle_that_verifies_is_named_by_its_content(bundle: Path) -> None:
    assert asyncio.run(verify(bundle)) == Bundle.load(bundle).sha256


def test_what_is_wrong_comes_back(bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(BadBundle, match=r"manifest\.json cannot be opened"):
        asyncio.run(verify(tmp_path))
    copy = Path(shutil.copytree(bundle, tmp_path / "copy"))
    with pytest.raises(BadBundle, match="ended the process"):
        asyncio.run(verify(copy, [tmp_path / "no-such-key.pem"]))


def test_one_that_takes_too_long_is_ended(bundle: Path) -> None:
    before = _children()
    with pytest.raises(BadBundle, match=r"more than 0\.001 s"):
        asyncio.run(verify(bundle, timeout_s=0.001))
    assert _children() <= before


def _children() -> set[str]:
    """The processes that this one has started and not waited for: other tests' may be among them."""
    children: set[str] = set()
    for task in Path(f"/proc/{os.getpid()}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has ended in the meantime
            children.update((task / "children").read_text().split())
    return children


def test_the_process_is_bounded(bundle: Path) -> None:
    """Whatever a graph makes of its memory, the verifier has no more than its limit."""
    code = "import sys, resource; from server import verifier; sys.argv = ['v', sys.argv[1]]; verifier.main(); "
    code += "print(*(resource.getrlimit(limit)[0] for limit in (resource.RLIMIT_AS, resource.RLIMIT_CORE)))"
    command = [sys.executable, "-c", code, str(bundle)]
    lines = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout.splitlines()
    assert lines[-1] == f"{8 * 2**30} 0"
