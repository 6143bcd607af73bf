"""A breaker that is open is closed again by a bundle that is fast once it is warm, and by no other."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bot_runtime.bots import Bots
from bot_runtime.breaker import Probe
from bot_runtime.bundle import Bundle


def probed(bots: Bots, monkeypatch: pytest.MonkeyPatch, runs_us: list[float]) -> tuple[float, int]:
    """What a probe that may take 100 us says of runs that take so long, and how many of them it made."""
    left: Iterator[float] = iter(runs_us)
    monkeypatch.setattr(bots._policy, "check_batch", lambda n_bots, clock: next(left))
    return bots.probe(Probe(2, 100.0)), len(runs_us) - len(list(left))


@pytest.mark.parametrize(
    ("runs_us", "took_us", "n_runs"),
    [
        ([430.0, 120.0, 77.0, 64.0], 77.0, 3),
        ([99.0, 50.0], 99.0, 1),
        ([300.0] * 20, 300.0, 8),
        ([2001.0, 10.0], 2001.0, 1),
    ],
    ids=["cold", "fast", "slow", "hopeless"],
)
def test_a_probe_is_measured_warm(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, runs_us: list[float], took_us: float, n_runs: int
) -> None:
    assert probed(Bots(bundle, max_bots=2), monkeypatch, runs_us) == (took_us, n_runs)
