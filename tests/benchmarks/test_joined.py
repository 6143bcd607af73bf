"""The benchmark of a socket's two ends plays real turns through both; what it measures is not judged here."""

from __future__ import annotations

from pathlib import Path

from benchmarks.joined import Joined, measure
from tests.bundles import make_bundle


def test_it_measures_both_by_number_of_bots(tmp_path: Path) -> None:
    found = measure(Joined(make_bundle(tmp_path / "tiny"), bots=(1, 3), rounds=2))
    assert list(found) == ["in process", "joined", "beyond"]
    assert all(set(rows) == {1, 3} for rows in found.values())
    assert all(0.0 < least <= median for name in ("in process", "joined") for least, median in found[name].values())
