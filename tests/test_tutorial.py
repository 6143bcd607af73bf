"""The tutorial's files and commands, as they stand on the page, in an empty folder; what it says they print is printed.

What was learned depends on the processor's rounding: of that, the page's claims are checked and not its figures.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from subprocess import PIPE
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "tutorials" / "your-own-environment.md").read_text(encoding="utf-8")
SET_UP = "make .venv/all\n. .venv/bin/activate\n"
COMMANDS_S = 300.0  # for one block, where others keep the machine busy


class Block(NamedTuple):
    kind: str
    file: str  # that the page last named before it
    text: str


def blocks() -> Iterator[Block]:
    """Every fenced block of the page, in order."""
    for match in re.finditer(r"^```(\w*)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE):
        named = re.findall(r"`(out/tutorial/[^`]+)`", PAGE[: match.start()])
        yield Block(match[1], named[-1] if named else "", match[2])


def run(commands: str, folder: Path) -> str:
    """What they print; they and all that they started have ended."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    env = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "120"}
    bash = ["bash", "-euo", "pipefail", "-c", commands]
    with subprocess.Popen(
        bash, cwd=folder, env=env, text=True, stdout=PIPE, stderr=PIPE, start_new_session=True
    ) as running:
        try:
            printed, errors = running.communicate(timeout=COMMANDS_S)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGKILL)
    assert running.returncode == 0, f"{commands}{printed}{errors}"
    return printed


def read(folder: Path, name: str) -> dict[str, float]:
    """What an evaluation wrote."""
    return json.loads((folder / "out" / "tutorial" / name).read_text())


def test_every_block_is_of_a_kind_that_is_checked() -> None:
    assert {block.kind for block in blocks()} == {"sh", "bash", "python", "json", "text"}
    assert [block.text for block in blocks() if block.kind == "sh"] == [SET_UP]


def test_the_set_up_is_that_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert all(any(line.startswith(command) for line in readme) for command in SET_UP.splitlines())


@pytest.mark.timeout(900)
def test_from_an_environment_to_a_served_bot(tmp_path: Path) -> None:
    """One test, for two workers would both run the page."""
    printed = []
    for block in blocks():
        if block.kind == "bash":
            printed.append(run(block.text, tmp_path))
        elif block.kind in ("python", "json"):
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        elif block.kind == "text":
            lines = [line.rstrip() for line in printed[-1].splitlines()]
            assert [line for line in block.text.splitlines() if line not in lines] == [], printed[-1]

    # Looking pays, and costs about what was asked for.
    much, little, nothing = (read(tmp_path, f"cost-{cost}.json") for cost in (40, 20, 0))
    assert much["return_mean"] > little["return_mean"] > 2.0 * nothing["return_mean"]
    assert much["return_mean"] > 350.0
    assert nothing["hard_cost_pct"] == 0.0 < little["hard_cost_pct"] < much["hard_cost_pct"] < 60.0
    assert [each["violations"] for each in (much, little, nothing)] == [0, 0, 0]

    # The served bot looks, within its budget: one of two features at 5 µs.
    (play,) = re.findall(r"^return (\S+), (\S+) µs a frame, at most (\S+)$", "".join(printed), re.MULTILINE)
    total, mean_us, most_us = map(float, play)
    assert total > 100.0
    assert 0.0 < mean_us < most_us == 5.0

    assert printed[-1].count(" new ") == 9
    assert [os.listdir(folder) for folder in (tmp_path, tmp_path / "out")] == [["out"], ["tutorial"]]
    assert not (tmp_path / "out" / "tutorial" / "server.json").exists()
