"""The short form of the million frames, and proof that its oracle sees what it should."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from benchmarks import budget
from benchmarks.budget import Budget, Tally, judge, main
from benchmarks.outputs import Case
from tests.bundles import make_bundle

SOURCES = {"trained", "random", "all_ones", "hostile", "adversarial"}


@pytest.fixture(scope="module")
def bundle_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


def test_no_violations_in_ten_thousand_frames(bundle_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(Budget(frames=10_001, bundle=bundle_path, ray_frames=0, repeats=2, json=True)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    result = json.loads(lines[0])
    assert result["violations"] == 0
    assert result["frames"] == 10_001
    assert result["measured_over_pct"] is None
    assert set(result["by_source"]) == SOURCES
    for tally in result["by_source"].values():
        assert tally["frames"] >= 2000
        assert tally["shared_frames"] > 200
        assert tally["cut_frames"] > 200
        assert 0.99 < tally["worst_ratio"] <= 1.0


def test_the_table_names_every_source(bundle_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(Budget(frames=50, bundle=bundle_path, ray_frames=5, calibration=5, ray_bots=2, repeats=2)) == 0
    printed = capsys.readouterr().out
    assert all(words in printed for words in [*SOURCES, "500 bots x 64 rays", "by the cpu clock", "charged µs"])


def test_overspending_is_found(
    bundle_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(budget, "allocate", lambda probs_NM, sampled_NM, **rest: sampled_NM)
    assert main(Budget(frames=1000, bundle=bundle_path, ray_frames=0, repeats=2, json=True)) == 1
    result = json.loads(capsys.readouterr().out)
    assert all(tally["violations"] > 0 for tally in result["by_source"].values())


def test_an_allocation_without_a_margin_is_found(
    bundle_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums that are right as floats and wrong as numbers: only the adversarial source meets them."""
    monkeypatch.setattr("bot_runtime.budget._MARGIN_PER_TERM", 0.0)
    assert main(Budget(frames=10_000, bundle=bundle_path, ray_frames=0, repeats=2, json=True)) == 1
    assert json.loads(capsys.readouterr().out)["by_source"]["adversarial"]["violations"] > 0


@pytest.mark.parametrize(
    ("asked", "budget_us", "frame_budget_us", "violations"),
    [
        ([True, True], 1.3, None, 0),
        ([True, True], math.nextafter(0.1 + 0.2 + 1.0, 0.0), None, 1),
        ([True, True], math.inf, 1.2, 1),
        ([True, True], 1.2, 1.2, 2),
        ([False, False], math.nan, -1.0, 0),
        ([True, False], math.nan, None, 1),
        ([True, False], -1.0, None, 1),
        ([True, False], math.inf, math.nan, 1),
        ([False, True], 1.3, None, 1),  # asked for without having been sampled
    ],
)
def test_the_oracle(asked: list[bool], budget_us: float, frame_budget_us: float | None, violations: int) -> None:
    """0.1 + 0.2 is 0.3 and a bit as floats; the call costs 1."""
    query, sampled = np.array([asked]), np.array([[True, asked[0]]])
    budgets, tally = np.array([budget_us]), Tally()
    case = Case(np.ones((1, 2)), sampled, np.array([0.1, 0.2]), 1.0, budgets, frame_budget_us)
    judge(case, query, tally)
    assert tally.violations == violations
