"""Frames over a bad line, in short: every fault befalls some, every frame is committed once."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.chaos import Chaos, Outcome, play
from benchmarks.fault_proxy import FaultProxy, Faults
from protocol.client import BotClient
from tests.bundles import make_bundle
from tests.server.serving import serve

FAULTS = {"passed", "duplicated", "reordered", "request lost", "request cut", "reply lost", "reply cut"}


def _played(folder: Path, config: Chaos) -> tuple[Outcome, FaultProxy]:
    with serve(config.bundle, folder / "s") as served:
        proxy = FaultProxy(served.addresses["http"], config.faults, config.seed)
        with proxy.listening() as address, BotClient(address) as client:
            return play(client, config, iter), proxy


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return make_bundle(tmp_path / "tiny", budget=0.9)


def test_every_frame_is_committed_once_whatever_befalls_its_messages(bundle: Path, tmp_path: Path) -> None:
    outcome, proxy = _played(tmp_path, Chaos(bundle, frames=250, bots=2, delay_ms=0.2))
    assert (outcome.frames, outcome.differing) == (250, 0)
    assert outcome.passed
    assert set(proxy.befell) == FAULTS
    assert proxy.befell.total() > 600


def test_a_server_that_commits_retries_again_is_found(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bot_runtime.turns.is_retry", lambda *_: False)
    config = Chaos(bundle, frames=60, bots=1, loss=0.0, duplicates=0.0, reordered=0.0)
    assert _played(tmp_path, config)[0].passed
    assert not _played(tmp_path, Chaos(bundle, frames=60, bots=1, duplicates=0.0, reordered=0.0))[0].passed


def test_faults_are_shares() -> None:
    with pytest.raises(ValueError, match="together less than 1"):
        Faults(loss=0.9, duplicates=0.1)


def test_the_command_prints_one_line_and_says_whether_it_passed(bundle: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.chaos", "--bundle", str(bundle), "--frames", "20", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    line = json.loads(done.stdout)
    assert (line["frames"], line["differing"], line["passed"]) == (20, 0, True)
