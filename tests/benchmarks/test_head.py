"""The benchmark plays real frames both ways over real doors, and both ask the same; times are not judged here."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from benchmarks.head import HeadInEngine, measure
from tests.bundles import make_bundle


def test_both_ways_are_timed_and_ask_the_same(tmp_path: Path) -> None:
    config = HeadInEngine(make_bundle(tmp_path / "tiny"), bots=(1, 3), turns=7, pin=False)
    times = measure(config, Console(quiet=True))
    assert {door: set(by_bots) for door, by_bots in times.items()} == {"unix": {1, 3}, "tcp": {1, 3}, "http": {1, 3}}
    for by_bots in times.values():
        for each in by_bots.values():
            assert each.two_us.shape == each.one_us.shape == each.head_us.shape == (7,)
            assert (each.one_us > each.head_us).all()
            assert each.different == 0
