"""The latency benchmark plays real turns over real doors; what it measures is not judged here."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from rich.console import Console

from benchmarks.engine import can_build
from benchmarks.latency import Latency, measure
from tests.bundles import make_bundle

DOORS = {"inproc", "uds", "tcp", "ws", "http"} | ({"uds C", "tcp C"} if can_build() else set())


def test_every_transport_plays_every_turn(tmp_path: Path) -> None:
    config = Latency(make_bundle(tmp_path / "tiny"), bots=(1, 3), turns=7, pin=False)
    times = measure(config, Console(quiet=True))
    assert {name: {n: rows.shape for n, rows in by_bots.items()} for name, by_bots in times.items()} == {
        name: {1: (7, 2), 3: (7, 2)} for name in DOORS
    }
    for by_bots in times.values():
        for rows in by_bots.values():
            assert (rows[:, 0] > rows[:, 1]).all(), "a turn takes longer than the model in it"
            assert (rows > 0).all()


def test_json_is_one_line(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    command = [sys.executable, "-m", "benchmarks.latency", "--bundle", str(bundle), "--json"]
    command += ["--bots", "2", "--turns", "3", "--no-pin", "--spin-us", "200"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    (line,) = done.stdout.splitlines()
    printed = json.loads(line)
    assert set(printed) == DOORS
    for by_bots in printed.values():
        quantiles = by_bots["2"]
        assert 0 < quantiles["p50_us"] <= quantiles["p99_us"] <= quantiles["p999_us"]
