"""How commands end, as processes: one line for what a user can mend, and no remains."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol.errors import BadBundle
from tests.training.logs import rows, write_csv
from training.command import command, terminable

ROOT = Path(__file__).resolve().parents[2]


def run(folder: Path, *arguments: str, python: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, *python, "-m", *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.mark.parametrize("error", [ValueError("no such thing"), OSError("no such thing"), BadBundle("no such thing")])
def test_what_a_user_can_mend_is_one_line(error: Exception) -> None:
    with pytest.raises(SystemExit) as ended, command():
        raise error
    assert ended.value.code == f"error: {error}"


def test_a_fault_of_ours_keeps_its_traceback() -> None:
    with pytest.raises(RuntimeError), command():
        raise RuntimeError("a bug")


def test_ctrl_c_says_what_becomes_of_the_work() -> None:
    with pytest.raises(SystemExit, match="stopped: nothing was written"), command("stopped: nothing was written"):
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("training.train", "--config", "none.json"), "none.json"),
        (("training.train", "--dataset", "nowhere", "--out", "run", "--name", "a"), "nowhere is not a Minari dataset"),
        (("training.export", "nowhere", "out"), "nowhere/checkpoint.pt"),
        (("training.evaluate", "nowhere"), "BAD_BUNDLE: manifest.json"),
        (("training.evaluate", str(ROOT / "bundles" / "easy"), "--environment", "Nope-v0"), "Nope"),
        (("training.evaluate", str(ROOT / "bundles" / "easy"), "--environment", "nope:Nope-v0"), "nope"),
        (
            ("training.evaluate", str(ROOT / "bundles" / "easy"), "--out", "nowhere/e.json"),
            "is a folder or in none",
        ),
        (("training.draft_map", "nowhere", "map.json"), "nowhere is not a Minari dataset"),
    ],
    ids=lambda part: "-".join(part)[-40:] if isinstance(part, tuple) else "",
)
def test_commands_say_in_one_line_what_is_wrong(tmp_path: Path, arguments: tuple[str, ...], said: str) -> None:
    ended = run(tmp_path, *arguments)
    [line] = [line for line in ended.stderr.splitlines() if line and not line.startswith("evaluating")]
    assert line.startswith("error: ")
    assert said in line
    assert ended.returncode == 1
    assert os.listdir(tmp_path) == []


def test_a_developer_sees_where_it_came_from(tmp_path: Path) -> None:
    assert "Traceback" in run(tmp_path, "training.sign", "--bundle", "b", "--key", "k", python=("-X", "dev")).stderr


def test_terminated_it_cleans_up(tmp_path: Path) -> None:
    write_csv(tmp_path / "log.csv", rows(*[500] * 400))
    (tmp_path / "columns.json").write_text(
        '{"episode": "match", "observation": ["health"], "action": ["turn"], "reward": "score"}'
    )
    command = [sys.executable, "-m", "training.import_traces", "log.csv", "big-v0", "--columns", "columns.json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL) as importing:
        while not list(tmp_path.glob(".dataset-*/main.hdf5")):
            assert importing.poll() is None
            time.sleep(0.001)
        importing.terminate()
        assert importing.wait(timeout=60) == 128 + signal.SIGTERM
    assert sorted(os.listdir(tmp_path)) == ["columns.json", "log.csv"]


def test_the_signal_means_what_it_meant_afterwards() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with terminable():
        assert signal.getsignal(signal.SIGTERM) is not before
    assert signal.getsignal(signal.SIGTERM) is before
