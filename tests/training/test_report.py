"""A report says what was measured, where the paper's table has it, and says so where nothing was."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.training.synthetic import NAMES, write_evaluation, write_heat_map, write_metrics, write_run
from training.config import TrainConfig
from training.curves import plot_curves
from training.figures import Panel, heat_map_figure, ray_order
from training.heat_map import HeatMap
from training.paper import PaperPoint, read_paper, shown_beside
from training.report import ReportConfig, report
from training.results import BASE, Results, Setting
from training.tables import cost_table, spend_table

PAPER_CSV = Path(__file__).parents[3] / "shared" / "paper" / "table_navigation.csv"
PAPER = """dataset,map,constraint,bdt_cost_pct,bdt_return,bdt_std,rcbc_cost_pct,rcbc_return,rcbc_std
expert,hard,base,100.0,82.7,1.0,100.0,76.2,1.0
expert,hard,0.10,10.2,78.8,2.4,7.7,72.5,5.1
expert,hard,0.01,2.9,71.6,1.5,,,
"""
HARD = Setting("hard", "expert")
CONDITIONED = {"budgets": (0.003, 0.01, 0.1, 1.0), "control": "dual"}


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two seeds of BDT at two budgets, one of RCBC, one conditioned network, all features, random queries."""
    folder = tmp_path / "results"
    for seed in (0, 1):
        for cost, value in (("0.1", 80.0), ("0.01", 60.0)):
            run = write_run(folder, f"bdt-c{cost}-s{seed}", seed=seed, budget=float(cost))
            write_evaluation(run, f"soft-{cost}", value + 2 * seed, 120 * float(cost), 119 * float(cost))
            write_evaluation(run, f"hard-{cost}", value - 10, 120 * float(cost), 90 * float(cost), violations=seed)
            write_metrics(run)
    rcbc = write_run(folder, "rcbc-c0.1-s0", method="rcbc", budget=0.1)
    write_evaluation(rcbc, "soft-0.1", 71.5, 7.0, 7.0, episodes=64)
    write_heat_map(rcbc)
    write_heat_map(folder / "bdt-c0.1-s0", 1)
    conditioned = write_run(folder, "bdt-conditioned-s0", **CONDITIONED)
    for cost, value in (("1", 88.0), ("0.1", 85.0), ("0.03", 77.0)):
        write_evaluation(conditioned, f"soft-{cost}", value, 100 * float(cost), 100 * float(cost))
    write_metrics(conditioned)
    write_evaluation(write_run(folder, "all", acquisition="all"), "soft-1", 90.0, 100.0, 100.0)
    random = write_run(folder, "random", acquisition="random", budget=0.1, method="bdt")
    write_evaluation(random, "soft-0.1", 33.3, 10.0, 10.0)
    return folder


@pytest.fixture
def paper(tmp_path: Path) -> Path:
    path = tmp_path / "paper.csv"
    path.write_text(PAPER)
    return path


def cells(table: str) -> dict[tuple[str, str], str]:
    """Text by row and column."""
    head, _, *body = [re.split(r"(?<!\\) \| ", line[2:-2]) for line in table.splitlines()]
    return {(row[0], column): text for row in body for column, text in zip(head[1:], row[1:], strict=True)}


def test_numbers_land_in_their_cells(results: Path, paper: Path) -> None:
    table = cells(cost_table(Results.read(results).of(HARD), HARD, read_paper(paper)))
    assert (
        table["10 %", "BDT"]
        == r"soft 12.0 % \| R = 81.0 ± 1.4 (n=2)<br>hard 9.0 % of 12.0 % asked \| R = 70.0 ± 0.0 (n=2)"
    )
    assert table["1 %", "BDT"].startswith(r"soft 1.2 % \| R = 61.0 ± 1.4 (n=2)<br>hard 0.9 % of 1.2 % asked")
    assert table["10 %", "RCBC"] == r"soft 7.0 % \| R = 71.5 (n=1)<br>hard: not measured"
    assert table["base", "BDT"] == r"soft 100.0 % \| R = 90.0 (n=1)"
    assert table["base", "BDT conditioned (dual)"] == r"soft 100.0 % \| R = 88.0 (n=1)"
    assert table["10 %", "BDT random"].startswith(r"soft 10.0 % \| R = 33.3 (n=1)")
    assert table["3 %", "BDT conditioned (dual)"].startswith(r"soft 3.0 % \| R = 77.0 (n=1)")


def test_what_was_not_measured_says_so(results: Path, paper: Path) -> None:
    table = cells(cost_table(Results.read(results).of(HARD), HARD, {}))
    for row in ("base", "10 %", "1 %"):
        assert table[row, "BC"] == table[row, "IQL"] == "not measured"
    assert table["3 %", "BDT"] == table["base", "RCBC"] == "not measured"
    empty = cells(cost_table([], HARD, read_paper(paper)))
    ours = {row: text for (row, _), text in empty.items() if "paper" not in row}
    assert ours == dict.fromkeys(("base", "10 %", "1 %"), "not measured")


def test_the_papers_rows_stand_where_it_has_them_and_are_marked(results: Path, paper: Path) -> None:
    measurements = Results.read(results).of(HARD)
    table = cells(cost_table(measurements, HARD, read_paper(paper)))
    assert table["*paper, 10 %*", "BDT"] == r"*10.2 % \| R = 78.8 ± 2.4*"
    assert table["*paper, base*", "RCBC"] == r"*100.0 % \| R = 76.2 ± 1.0*"
    assert table["*paper, 1 %*", "RCBC"] == table["*paper, 10 %*", "BDT conditioned (dual)"] == "–"
    assert not {row for row, _ in table} & {"*paper, 50 %*", "*paper, 3 %*", "*paper, 0 %*"}
    elsewhere = Setting("easy", "expert")
    assert "paper" not in cost_table(measurements, elsewhere, read_paper(paper))


def test_the_papers_rows_can_stand_beside_traces_of_another_name(results: Path, paper: Path) -> None:
    measurements, ours = Results.read(results).of(HARD), HARD._replace(dataset="nearsighted")
    elsewhere = Setting("easy", "nearsighted")
    theirs = read_paper(paper)
    shown = shown_beside(theirs, "expert", [HARD, ours, elsewhere])
    assert theirs.items() <= shown.items()
    rows = [cells(cost_table(measurements, setting, shown)) for setting in (HARD, ours)]
    assert rows[0] == rows[1]
    assert "paper" not in cost_table(measurements, elsewhere, shown)
    assert shown_beside(theirs, "", [ours]) == theirs


def test_equal_spend_is_interpolated_and_dashed_outside(results: Path, paper: Path) -> None:
    measurements = Results.read(results).of(HARD)
    table = cells(spend_table(measurements, HARD, "soft", (1.2, 5.0, 12.0, 20.0), read_paper(paper)))
    assert table["BDT", "1.2 %"] == "61.0 ± 1.4 (n=2)"
    assert table["BDT", "12 %"] == "81.0 ± 1.4 (n=2)"
    between = 61.0 + 20.0 * np.log(5.0 / 1.2) / np.log(10.0)
    assert table["BDT", "5 %"] == f"{between:.1f} ± 1.4 (n=2)"
    assert table["BDT", "20 %"] == table["RCBC", "5 %"] == table["BC", "5 %"] == "–"
    assert re.fullmatch(r"\*7\d\.\d\*", table["*BDT, paper's means*", "5 %"])
    assert table["*BDT, paper's means*", "12 %"] == table["*RCBC, paper's means*", "5 %"] == "–"
    assert "paper" not in spend_table(measurements, HARD, "hard", (5.0,), read_paper(paper))


def test_report_writes_every_figure_twice_and_says_what_was_measured(results: Path, paper: Path) -> None:
    (results / "all" / "evaluations" / "other.json").write_text("{}")
    path = report(ReportConfig(results, (paper,)))
    text = path.read_text()
    figures = {file.name for file in (path.parent / "figures").iterdir()}
    names = {
        "performance-hard-expert", "heat-map-hard-expert-c0.1", "training-bdt-hard-expert",
        "training-bdt-conditioned-hard-expert",
    }  # fmt: skip
    assert figures == {f"{name}{suffix}" for name in names for suffix in (".png", ".svg")}
    for name in names:
        assert f"](figures/{name}.png)" in text
    assert "14 evaluations of 64 to 256 episodes each, training seeds 0, 1." in text
    assert "Frames that passed a hard budget: 2." in text
    assert "256 episodes, training seed 0." in text
    assert "the paper's own" in text
    assert "left out: all/evaluations/other.json." in text


def test_command_line_works_without_the_paper_and_writes_the_same_twice(tmp_path: Path) -> None:
    results, out = tmp_path / "results", tmp_path / "out"
    write_evaluation(write_run(results, "run"), "soft-0.1", 80.0, 9.0, 9.0)
    command = [sys.executable, "-m", "training.report", str(results), "--out", str(out)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == str(out / "report.md")
    assert "paper" not in (out / "report.md").read_text()
    again = report(ReportConfig(results, out=tmp_path / "again")).parent
    for name in ("report.md", "figures/performance-hard-expert.svg", "figures/performance-hard-expert.png"):
        assert (again / name).read_bytes() == (out / name).read_bytes(), name


def test_runs_under_way_have_a_report_too(tmp_path: Path) -> None:
    write_run(tmp_path, "run")
    text = report(ReportConfig(tmp_path)).read_text()
    assert "Nothing was measured." in text


def test_rays_are_ordered_by_range_then_from_left_to_right() -> None:
    shuffled = ["wind", *np.random.default_rng(0).permutation(NAMES).tolist(), "noise"]
    ordered = [shuffled[i] for i in ray_order(shuffled)]
    assert ordered == [*NAMES, "wind", "noise"]


def test_a_heat_map_leaves_out_what_few_episodes_reach(tmp_path: Path) -> None:
    run = write_run(tmp_path, "run")
    write_heat_map(run)
    heat = HeatMap.read(run / "heat_map.npz")
    figure = heat_map_figure([Panel("BDT", heat), Panel("RCBC", heat)])
    image = figure.axes[0].images[0].get_array()
    assert image.shape == (len(NAMES), int((heat.alive_T >= 25.6).sum()))
    np.testing.assert_array_equal(image[0], heat.probs_TM[: image.shape[1], 0])
    with pytest.raises(ValueError, match="different features"):
        heat_map_figure([Panel("BDT", heat), Panel("RCBC", heat._replace(names=tuple(reversed(NAMES))))])


def test_a_heat_map_of_a_conditioned_network_is_known_by_what_it_asked_for(tmp_path: Path) -> None:
    run = write_run(tmp_path, "run", budget=0.1, **CONDITIONED)
    write_heat_map(run)
    write_evaluation(run, "soft-0.1", 80.0, 9.0, 9.0)
    assert "C = unknown. 256 episodes" in report(ReportConfig(tmp_path)).read_text()
    write_evaluation(run, "soft-0.01", 80.0, HeatMap.read(run / "heat_map.npz").cost_pct, 9.0)
    assert "C = 0.01. 256 episodes" in report(ReportConfig(tmp_path)).read_text()


@pytest.mark.parametrize("settings", [{}, CONDITIONED, {"control": "dual"}])
def test_curves_of_one_run_are_drawn(tmp_path: Path, settings: dict[str, object]) -> None:
    run = write_run(tmp_path, "run", **settings)
    write_metrics(run)
    plot_curves(run / "metrics.jsonl", tmp_path / "curves.png", TrainConfig.read(run / "config.json"))
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_refuses_spends_and_papers_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected one or more above 0"):
        ReportConfig(tmp_path, spends=(0.0,))
    (tmp_path / "paper.csv").write_text(PAPER.replace("78.8", "many"))
    with pytest.raises(ValueError, match=r"paper.csv line 3: .*many"):
        read_paper(tmp_path / "paper.csv")


@pytest.mark.skipif(not PAPER_CSV.exists(), reason="the paper's table is not part of this repository")
def test_reads_the_papers_own_table() -> None:
    table = read_paper(PAPER_CSV)
    assert len(table) == 40
    assert table[HARD, "BDT", 0.01] == PaperPoint(2.9, 71.6, 1.5)
    assert table[Setting("easy", "intermediate"), "RCBC", BASE] == PaperPoint(100.0, 101.9, 0.7)
