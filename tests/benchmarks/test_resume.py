"""kill -9 of a real server while an engine plays: what the engine sees is the run without kills."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.resume import Resume, measure
from tests.bundles import make_bundle


@pytest.mark.parametrize("door", ["unix", "http"])
def test_killed_servers_are_not_noticed(tmp_path: Path, door: str) -> None:
    outcome = measure(Resume(make_bundle(tmp_path / "tiny"), kills=1, frames=10, bots=2, door=door, seed=1))
    assert (outcome.kills, outcome.lost_frames, outcome.different_frames) == (1, 0, 0)
    assert outcome.resumed == 1
    assert outcome.frames >= 10
