"""Figures of made-up episodes, against sums done by hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from game.env import ACTION_SPEC, feature_table
from game.layout import Layout
from game.squad import Episode, Leg
from game.summary import full_features_return, print_summary, summarise
from protocol.client import Welcome
from protocol.features import CostModel

TABLE = feature_table()
COSTS_M = TABLE.costs_us
LAYOUT = Layout((0.0, 0.0), 0.0, (5.0, 5.0), (), (), ())


def welcome(budget_us: float) -> Welcome:
    return Welcome("c", "made-up", TABLE, ACTION_SPEC, CostModel.declared(TABLE), budget_us, 20, 8, 1000)


def episode(asked: list[int], *, total: float = 50.0, reached: bool = False, died: bool = False) -> Episode:
    """One that asks for the first `asked[t]` rays in turn t."""
    queries_TM = np.arange(len(COSTS_M)) < np.array(asked)[:, None]
    cast_us_T = np.where(np.arange(len(asked)) == 0, np.nan, 10.0)
    full_us_T = np.where(np.arange(len(asked)) == 0, 100.0, np.nan)
    path_m = np.zeros((len(asked) + 1, 2))
    charged_us_T = np.array(asked) * 3.0
    return Episode(7, LAYOUT, total, reached, died, path_m, queries_TM, cast_us_T, full_us_T, 0, charged_us_T)


def leg(*episodes: Episode, turn_us: tuple[float, ...] = (100.0, 300.0)) -> Leg:
    return Leg(list(episodes), np.array(turn_us), 60.0)


def test_sums_over_both_legs():
    http = leg(episode([0, 1, 2], total=100.0, reached=True), episode([3], total=20.0, died=True))
    summary = summarise(http, leg(episode([0, 0])), welcome(1000.0), "hard", 60.0, None)
    spent_us = sum(COSTS_M[:asked].sum() for asked in (0, 1, 2, 3, 0, 0))
    assert summary.return_mean == pytest.approx((100 + 20 + 50) / 3, abs=1e-3)
    assert (summary.reached, summary.died, summary.timed_out) == (1, 1, 1)
    assert summary.turns == 6
    assert summary.cost_pct == pytest.approx(100 * spent_us / (6 * COSTS_M.sum()), abs=1e-3)
    assert summary.declared_us_saved_per_frame == pytest.approx(COSTS_M.sum() - spent_us / 6, abs=0.02)
    assert (summary.rays_us_cast_per_frame, summary.rays_us_saved_per_frame) == (10.0, 90.0)
    assert summary.infer_us_per_frame == 20.0
    assert (summary.turn_us.http.p50, summary.turn_us.http.p99) == (200.0, 298.0)


@pytest.mark.parametrize(("asked", "violations"), [([4, 4, 4], 0), ([4, 5, 4], 1), ([96, 5, 96], 3)])
def test_a_query_dearer_than_the_budget_is_counted(asked, violations):
    budget_us = float(COSTS_M[:4].sum())
    summary = summarise(leg(episode(asked)), None, welcome(budget_us), "hard", None, None)
    assert summary.budget_violations == violations


def test_measured_costs_are_judged_by_what_was_charged():
    """4 rays are within the budget by declared costs and not at 3 µs a ray; the share of all is as declared."""
    played, budget_us = leg(episode([1, 4])), 11.9
    declared = summarise(played, None, welcome(budget_us), "hard", None, None)
    measured = summarise(played, None, welcome(budget_us), "hard", None, None, measured=True)
    assert (declared.budget_violations, measured.budget_violations) == (0, 1)
    assert (measured.largest_cost_us, measured.charged_us_per_frame) == (12.0, 7.5)
    assert measured.cost_pct == declared.cost_pct


def test_the_json_line_is_one_line_of_plain_json():
    summary = summarise(leg(episode([1])), None, welcome(1.0), "hard", None, None)
    line = summary.json_line()
    assert "\n" not in line
    figures = json.loads(line)
    assert figures["return_full_features"] is None
    assert figures["turn_us"] == {"http": {"p50": 200.0, "p99": 298.0}, "socket": None}


def test_people_read_the_same_figures(capsys):
    http = leg(episode([0, 5], total=45.0))
    print_summary(summarise(http, None, welcome(1.0), "hard", 60.0, None), Console(width=120))
    shown = capsys.readouterr().out
    assert "45.0, 75 % of the 60.0 with all rays" in shown
    assert "1 of 2 turns" in shown
    assert "by declared costs" in shown
    assert f"{10.0 / (COSTS_M[:5].sum() / 2):.2f} for what was cast, {100.0 / COSTS_M.sum():.2f} for all rays" in shown
    print_summary(summarise(http, None, welcome(1.0), "hard", 60.0, None, measured=True), Console(width=120))
    assert "charged 7.5 µs a turn" in capsys.readouterr().out


def test_the_model_with_all_rays_is_read_from_the_bundles_folder(tmp_path):
    assert full_features_return(None) is None
    assert full_features_return(tmp_path) is None
    (tmp_path / "full_features.json").write_text('{"return_mean": 93.5, "episodes": 256}')
    assert full_features_return(tmp_path) == 93.5
