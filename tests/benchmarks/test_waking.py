"""The benchmark of sleep plays real turns with every pair; what it measures is not judged here."""

from __future__ import annotations

from pathlib import Path

from benchmarks.waking import Waking, measure
from tests.bundles import make_bundle


def test_it_measures_every_pair(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    found = measure(Waking(bundle, client_us=(0.0, 100.0), server_us=(50.0,), rounds=1))
    assert list(found) == ["in process", "0 / 50", "100 / 50"]
    assert all(0.0 < row["p10_us"] <= row["p50_us"] <= row["p99_us"] for row in found.values())
    assert found["in process"]["beyond_us"] == 0.0
