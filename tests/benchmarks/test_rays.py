"""The frames of rays: what is counted, against clocks that do as they are told, and against real rays."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.rays import RayTally, cast_frames, play
from game.rays import cost_model, load_costs

TRUTH = cost_model(load_costs("pybullet"))


def test_frames_that_cost_what_rays_cost_stay_within_their_budgets() -> None:
    random = np.random.default_rng(0)

    def cast_us(query_NM: np.ndarray) -> float:
        return float(TRUTH.query_cost_us(query_NM).sum()) * math.exp(random.normal(0.0, 0.1))

    tally, report = play(800, 400, 3, "cpu", 0, cast_us)
    assert tally.violations == 0
    assert tally.cut_frames > 400
    assert tally.over_pct <= 0.5
    assert tally.used / tally.frames > 0.4
    assert report.frames >= tally.frames


def test_frames_that_take_too_long_are_counted_each_one() -> None:
    slow = iter(range(10**9))
    tally, report = play(
        300, 100, 4, "wall", 0, lambda query: 1e6 if next(slow) % 10 == 0 else float(TRUTH.query_cost_us(query).sum())
    )
    assert 0.08 * tally.frames < tally.over < 0.12 * tally.frames
    assert tally.worst > 10.0
    assert report.over >= tally.over


@pytest.mark.parametrize(("measured_us", "over"), [(9.9, 0), (10.0, 0), (10.1, 1)])
def test_a_frame_is_over_when_it_took_longer_than_its_budget(measured_us: float, over: int) -> None:
    tally = RayTally("cpu")
    tally.count(measured_us, 10.0, cut=True)
    tally.count(1.0, 10.0, cut=False)
    assert (tally.frames, tally.cut_frames, tally.over, tally.cut_over) == (2, 1, over, over)
    assert tally.over_pct == 50.0 * over
    assert tally.worst == pytest.approx(measured_us / 10.0)


def test_real_rays_take_time_and_no_rays_take_none() -> None:
    with cast_frames("easy", "cpu", 0) as cast_us:
        query = np.zeros((3, 96), dtype=np.bool_)
        assert cast_us(query) == 0.0
        query[0] = True
        assert cast_us(query) > 5.0
