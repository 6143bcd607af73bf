"""The benchmark of counting and scraping measures what it says."""

from __future__ import annotations

from benchmarks.observing import Options, measure


def test_it_measures_something_of_everything() -> None:
    found = measure(Options(requests=50, rounds=1))
    assert all(number > 0.0 for number in found.values())
    assert found["scrape_kb"] > 100
