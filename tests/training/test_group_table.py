"""The table of noisy features: ours beside the paper's."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.training.synthetic import write_evaluation, write_run
from training.group_table import group_table
from training.paper import PaperPoint, read_paper
from training.report import ReportConfig, report
from training.results import BASE, Results, Setting

NOISY = """feature_sets,constraint,cost,cost_std,normalized_return,return_std,no_noise_pct,low_noise_pct,high_noise_pct
N,base,,,92.5,,100,,
N+L,110.5,88.6,4.1,88.5,2.1,5.0,86.0,0.0
"""
RANDOM = """environment,dataset,constraint,cost_pct,normalized_return,std
halfcheetah,expert,0.50,48.8,4.3,1.1
"""
SETTING = Setting("halfcheetah", "medium-expert", "nl")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two seeds of one network for every budget."""
    folder = tmp_path / "results"
    for seed in (0, 1):
        run = write_run(
            folder, f"s{seed}", "halfcheetah-expert-v0", seed=seed, more_datasets=(Path("halfcheetah-medium-v0"),),
            feature_map=Path("halfcheetah-nl.json"), budgets=(0.05, 0.26, 1.0),
        )  # fmt: skip
        groups = {"exact": 4.0 + 2 * seed, "low": 80.0}
        write_evaluation(run, "soft-0.26", 80.0, 25.0, 25.0, acquired_pct=groups)
        write_evaluation(run, "soft-1", 90.0, 99.0, 99.0, acquired_pct={"exact": 99.0, "low": 99.0})
    return folder


@pytest.fixture
def paper(tmp_path: Path) -> Path:
    (tmp_path / "noisy.csv").write_text(NOISY)
    return tmp_path / "noisy.csv"


def test_groups_stand_beside_the_papers(results: Path, paper: Path) -> None:
    lines = group_table(Results.read(results).of(SETTING), SETTING, read_paper(paper)).splitlines()
    assert lines[0] == "|  | C | cost | R | exact | low |"
    assert lines[2:] == [
        "| BDT conditioned | 100 % | 99.0 % | 90.0 ± 0.0 (n=2) | 99.0 % | 99.0 % |",
        "| BDT conditioned | 26 % | 25.0 % | 80.0 ± 0.0 (n=2) | 5.0 % | 80.0 % |",
        "| *paper* | *26 %* | *20.8 %* | *88.5 ± 2.1* | *5.0 %* | *86.0 %* |",
    ]


def test_a_setting_without_groups_has_no_table(tmp_path: Path) -> None:
    write_evaluation(write_run(tmp_path, "run"), "soft-0.1", 80.0, 9.0, 9.0)
    results = Results.read(tmp_path)
    assert group_table(results.measurements, results.settings[0], {}) == ""
    assert "each group" not in report(ReportConfig(tmp_path)).read_text()


def test_the_report_has_it(results: Path, paper: Path) -> None:
    text = report(ReportConfig(results, (paper,))).read_text()
    assert "## halfcheetah medium-expert nl" in text
    assert "### Features of each group" in text


def test_the_papers_tables_are_told_apart(tmp_path: Path, paper: Path) -> None:
    (tmp_path / "random.csv").write_text(RANDOM)
    table = read_paper(paper, tmp_path / "random.csv")
    base = PaperPoint(100.0, 92.5, 0.0, {"exact": 100.0})
    assert table == {
        (Setting("halfcheetah", "medium-expert", "n"), "BDT", BASE): base,
        (SETTING, "BDT", 0.26): PaperPoint(100.0 * 88.6 / 425.0, 88.5, 2.1, {"exact": 5.0, "low": 86.0}),
        (Setting("halfcheetah", "expert"), "BDT random", 0.5): PaperPoint(48.8, 4.3, 1.1),
    }
