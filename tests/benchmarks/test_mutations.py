"""The short form of 10,000 spoilt bundles."""

from __future__ import annotations

from pathlib import Path

from benchmarks.mutations import Mutations, measure
from tests.bundles import make_bundle


def test_spoilt_files_and_spoilt_signed_manifests_are_refused_before_anything_is_parsed(tmp_path: Path) -> None:
    measured = measure(Mutations(make_bundle(tmp_path / "bundle"), count=300))
    before = {"before parsing": 300, "after parsing": 0, "accepted": 0}
    assert measured["files"] == measured["manifest or signature, signed"] == before
    assert sum(measured["manifest, unsigned"].values()) == 30
    assert measured["manifest, unsigned"]["before parsing"] > 20
