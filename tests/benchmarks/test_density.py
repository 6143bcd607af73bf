"""The open loop counts lateness from when a frame was due; the search finds the largest number that is carried."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.density import Density, search
from benchmarks.front import Front
from benchmarks.open_loop import Engine, Load, play_load
from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden, read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient
from tests.bundles import make_bundle
from tests.server.serving import serve


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


@pytest.fixture(scope="module")
def url(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serve(tiny, tmp_path_factory.mktemp("socket") / "s") as served:
        yield served.addresses["unix"]


@pytest.fixture(scope="module")
def recorded(tiny: Path) -> tuple[Bundle, Golden]:
    bundle = Bundle.load(tiny)
    return bundle, read_golden((tiny / "golden.npz").read_bytes(), bundle.manifest)


def load(*late_ms: float) -> Load:
    return Load(np.array(late_ms), 0.0)


@pytest.mark.parametrize("most_carried", [0, 63, 64, 65, 100, 333, 4000, 5000])
def test_the_search_ends_within_a_step_of_the_truth(most_carried: int) -> None:
    config, asked = Density(first=64, step=32, most=4096), []

    def run(bots: int) -> Load:
        asked.append(bots)
        return load(16.0 if bots <= most_carried else 17.0)

    found = search(run, config, lambda *_: None)
    assert found.bots <= max(most_carried, 0)
    if most_carried < 64:
        assert found == search(lambda bots: load(17.0), config, lambda *_: None)
        assert found.bots == 0
    else:
        assert min(most_carried, config.most) - found.bots <= config.step
    assert len(asked) < 40


def test_a_number_that_is_carried_once_in_its_attempts_is_carried() -> None:
    runs = iter(range(10**6))
    found = search(lambda bots: load(1.0 if next(runs) % 2 else 99.0), Density(attempts=2, most=256), lambda *_: None)
    assert found.bots == 256


def test_the_last_percent_of_frames_decides_and_one_that_was_given_up_is_the_latest() -> None:
    late = load(*[1.0] * 98, 20.0, np.inf)
    assert (late.ms(50.0), late.ms(98.0), late.ms(100.0)) == (1.0, 20.0, np.inf)
    assert late.ms(99.0) > 1e3 / 60.0


def test_a_frame_is_late_by_what_has_passed_since_it_was_due(url: str, recorded: tuple[Bundle, Golden]) -> None:
    """Two frames were due 5 s ago, one after the other is done: an answer that is prompt does not make them prompt."""
    engine = Engine(url, *recorded, 3)
    due_s = time.monotonic() - 5.0
    engine.due(due_s)
    engine.due(due_s)
    assert engine.n_waiting == 2
    while engine.n_waiting:
        engine.receive()
    engine.socket.close()
    assert len(engine.late_ms) == 2
    assert 5000.0 <= engine.late_ms[0] <= engine.late_ms[1]


def test_the_packed_messages_are_those_of_the_reference_client(url: str, recorded: tuple[Bundle, Golden]) -> None:
    """Every frame that is due is played, and the server refused none of them."""
    played = play_load(url, *recorded, (1, 3), 0.2, 60.0)
    assert played.late_ms.shape == (24,)
    assert (played.late_ms > 0.0).all()
    assert 0.0 <= played.busy <= 1.0


def test_a_refusal_ends_the_run(url: str, recorded: tuple[Bundle, Golden]) -> None:
    with BotClient(url) as client:
        room = client.hello().max_bots
    with pytest.raises(ConnectionError, match="TOO_MANY_BOTS"):
        play_load(url, *recorded, (room + 1,), 0.1, 60.0)


def test_json_is_one_line(tiny: Path) -> None:
    command = [sys.executable, "-m", "benchmarks.density", "--bundle", str(tiny), "--int8", str(tiny), "--json"]
    command += ["--first", "2", "--most", "4", "--engines", "2", "--seconds", "0.2", "--attempts", "1", "--no-pin"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    (line,) = done.stdout.splitlines()
    assert {0, 2, 4} >= {json.loads(line)["bots_fp32"], json.loads(line)["bots_int8"]}


@pytest.mark.skipif(shutil.which("haproxy") is None, reason="haproxy is not installed")
def test_engines_behind_a_front_are_spread_over_processes(tiny: Path, recorded: tuple[Bundle, Golden]) -> None:
    names = ("p1", "p2")
    arguments = ("--tcp-port", "0", "--max-bots", "6")  # of eight bots, neither process could hold all
    with (
        ServerProcess(tiny, *arguments, "--process", names[0]) as one,
        ServerProcess(tiny, *arguments, "--process", names[1]) as two,
        Front([one.addresses(), two.addresses()]) as front,
    ):
        assert play_load(front.tcp, *recorded, (2, 2, 2, 2), 0.1, 60.0).late_ms.size == 24
