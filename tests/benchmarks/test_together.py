"""The benchmark of turns taken together plays the same turns both ways; what it measures is not judged here."""

from __future__ import annotations

from pathlib import Path

from benchmarks.together import Together, measure
from tests.bundles import make_bundle


def test_it_measures_every_number_of_engines_and_bots(tmp_path: Path) -> None:
    found = measure(Together(make_bundle(tmp_path / "tiny"), engines=(2, 3), bots=(1, 2), turns=3))
    assert set(found) == {(2, 1), (2, 2), (3, 1), (3, 2)}
    assert all(min(row.apart_us, row.together_us, row.ratio) > 0.0 for row in found.values())
