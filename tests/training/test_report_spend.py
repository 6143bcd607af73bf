"""Returns at equal spend are read off measured curves, between their points and nowhere else."""

from __future__ import annotations

import math
import statistics
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.training.synthetic import write_evaluation, write_run
from training.results import Results
from training.spend import at_spend, return_at, statistic

SPENDS = st.floats(0.01, 100.0)
CURVES = st.lists(st.tuples(SPENDS, st.floats(-100.0, 100.0)), min_size=1, max_size=6, unique_by=lambda p: p[0])


@given(CURVES)
def test_is_exact_at_the_points(curve: list[tuple[float, float]]) -> None:
    for spend, value in curve:
        assert return_at(spend, curve) == value


@given(CURVES, SPENDS)
def test_stays_between_the_neighbours_and_within_what_was_measured(
    curve: list[tuple[float, float]], spend: float
) -> None:
    value = return_at(spend, curve)
    below = [point for point in curve if point[0] <= spend]
    above = [point for point in curve if point[0] >= spend]
    if not below or not above:
        assert value is None
        return
    (x0, y0), (x1, y1) = max(below), min(above)
    assert value is not None
    assert min(y0, y1) - 1e-9 <= value <= max(y0, y1) + 1e-9
    if x0 < spend < x1:
        share = math.log(spend / x0) / math.log(x1 / x0)
        assert value == pytest.approx(y0 + share * (y1 - y0), rel=1e-6, abs=1e-6)


@given(CURVES, SPENDS, SPENDS)
def test_a_rising_curve_never_falls(curve: list[tuple[float, float]], one: float, other: float) -> None:
    spends, values = zip(*curve, strict=True)
    rising = list(zip(sorted(spends), sorted(values), strict=True))
    low, high = (return_at(spend, rising) for spend in sorted((one, other)))
    if low is not None and high is not None:
        assert low <= high + 1e-9


def test_points_of_equal_spend_are_their_mean_and_nothing_spent_is_no_point() -> None:
    assert return_at(5.0, [(5.0, 60.0), (5.0, 80.0), (0.0, 10.0)]) == 70.0
    assert return_at(1.0, [(0.0, 10.0), (5.0, 60.0)]) is None
    with pytest.raises(ValueError, match="expected more than 0"):
        return_at(0.0, [(5.0, 60.0)])


def test_each_seed_has_its_own_curve(tmp_path: Path) -> None:
    """Seed 0 is read half way, in logarithms, between its points; seed 1 is not reached.

    Forced queries are no point of a curve.
    """
    for seed, points in enumerate(({"0.5": (16.0, 90.0), "0.1": (1.0, 50.0)}, {"0.5": (40.0, 95.0)})):
        for cost, (spend, value) in points.items():
            run = write_run(tmp_path, f"c{cost}-s{seed}", seed=seed, budget=float(cost))
            write_evaluation(run, f"soft-{cost}", value, spend, spend)
    write_evaluation(write_run(tmp_path, "all", acquisition="all"), "soft-1", 99.0, 100.0, 100.0)
    measurements = Results.read(tmp_path).measurements
    half = at_spend(4.0, measurements)
    assert half is not None
    assert (half.mean, half.std, half.n) == (pytest.approx(70.0), None, 1)
    assert at_spend(30.0, measurements) is None
    assert at_spend(100.0, measurements) is None


@given(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=5))
def test_statistics_are_those_of_a_sample(numbers: list[float]) -> None:
    ours = statistic(numbers)
    assert ours.mean == pytest.approx(statistics.fmean(numbers), abs=1e-9)
    if len(numbers) == 1:
        assert ours.std is None
    else:
        assert ours.std == pytest.approx(statistics.stdev(numbers), abs=1e-9)
