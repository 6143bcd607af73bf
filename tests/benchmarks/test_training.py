"""The benchmark of training times three ways to the same queries."""

from __future__ import annotations

import json
import subprocess
import sys

from benchmarks.training import Training, measure


def test_the_three_ways_reach_the_same_queries() -> None:
    measured = measure(Training(batch=3, window=8, repeats=2))
    assert measured["differing_queries"] == 0
    assert measured["queries"] == 2 * 3 * 8 * 96
    for name in ("sequential", "parallel", "incremental"):
        assert measured[f"{name}_per_s"] > 0


def test_prints_one_json_line() -> None:
    command = [sys.executable, "-m", "benchmarks.training", "--batch", "2", "--window", "4", "--repeats", "1", "--json"]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert json.loads(printed.strip().splitlines()[-1])["ratio_incremental"] > 0
