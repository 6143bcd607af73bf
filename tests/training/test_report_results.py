"""What a folder of results says, and what is refused in it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.training.synthetic import write_evaluation, write_run
from training.results import BASE, NO_RAYS, Results, Series, Setting


def test_reads_settings_series_and_constraints(tmp_path: Path) -> None:
    run = write_run(tmp_path, "a", seed=3, budget=0.1, control="dual", allocation="frame", frame_bots=20)
    write_evaluation(run, "soft-0.1", 80.0, 9.0, 9.1)
    write_evaluation(run, "hard-0.1", 75.0, 9.0, 6.0)
    everything = write_run(tmp_path, "b", "easy-intermediate-v0", acquisition="all")
    write_evaluation(everything, "soft-1", 99.0, 100.0, 100.0)
    nothing = write_run(tmp_path, "c", acquisition="none")
    write_evaluation(nothing, "soft-0", 20.0, 0.0, 0.0)
    results = Results.read(tmp_path)
    assert results.settings == [Setting("easy", "intermediate"), Setting("hard", "expert")]
    found = {(one.run.folder.name, one.kind, one.constraint) for one in results.measurements}
    assert found == {("a", "soft", 0.1), ("a", "hard", 0.1), ("b", "soft", BASE), ("c", "soft", NO_RAYS)}
    soft, hard = sorted(results.of(Setting("hard", "expert"))[:2], key=lambda one: one.kind, reverse=True)
    assert (soft.spend_pct, hard.spend_pct) == (9.0, 6.0)
    assert soft.run.series == Series("BDT", "dual, frame allocation")
    assert soft.seed == 3


@pytest.mark.parametrize(
    ("settings", "series"),
    [
        ({}, Series("BDT")),
        ({"method": "rcbc", "control": "dual"}, Series("RCBC", "dual")),
        ({"acquisition": "random"}, Series("BDT random")),
        ({"budgets": (0.01, 0.1, 1.0)}, Series("BDT conditioned")),
        ({"acquisition": "all", "control": "dual", "budgets": (0.01, 1.0)}, Series("BDT")),
    ],
)
def test_a_series_is_a_method_and_what_is_not_as_printed(
    tmp_path: Path, settings: dict[str, object], series: Series
) -> None:
    write_run(tmp_path, "run", **settings)
    assert Results.read(tmp_path).runs[0].series == series


@pytest.mark.parametrize(
    ("dataset", "settings", "setting"),
    [
        ("hard-expert-v0", {}, Setting("hard", "expert")),
        ("d4rl_halfcheetah", {}, Setting("", "d4rl_halfcheetah")),
        ("hopper-expert-v0", {"more_datasets": (Path("hopper-medium-v0"),)}, Setting("hopper", "medium-expert")),
        ("hard-expert-v0", {"more_datasets": (Path("kicked/hard-expert-v0"),)}, Setting("hard", "expert")),
        ("hopper-expert-v0", {"more_datasets": (Path("mine"),)}, Setting("", "hopper-expert-v0+mine")),
        ("hopper-expert-v0", {"feature_map": Path("maps/hopper.json")}, Setting("hopper", "expert")),
        ("hopper-expert-v0", {"feature_map": Path("maps/hopper-nl.json")}, Setting("hopper", "expert", "nl")),
    ],
)
def test_a_setting_is_what_is_played(
    tmp_path: Path, dataset: str, settings: dict[str, object], setting: Setting
) -> None:
    write_run(tmp_path, "run", dataset, **settings)
    assert Results.read(tmp_path).runs[0].setting == setting


def test_reference_returns_are_0_and_100(tmp_path: Path) -> None:
    for name, references in (("raw", None), ("normalised", (-10.0, 90.0))):
        write_evaluation(write_run(tmp_path / name, "run", reference_returns=references), "soft-0.1", 40.0, 9.0, 9.0)
    values = {name: Results.read(tmp_path / name).measurements[0].value for name in ("raw", "normalised")}
    assert values == {"raw": 40.0, "normalised": 50.0}


def test_two_networks_of_one_cell_are_no_two_seeds(tmp_path: Path) -> None:
    for name, width in (("small", 32), ("large", 64)):
        write_evaluation(write_run(tmp_path, name, width=width), "soft-0.1", 80.0, 9.0, 9.0)
    with pytest.raises(ValueError, match=r"both BDT with seed 0 at C = 0.1, and differ in \['width'\]"):
        Results.read(tmp_path)


def test_a_label_that_is_not_what_was_asked_for_is_refused(tmp_path: Path) -> None:
    write_evaluation(write_run(tmp_path, "run", budget=0.1), "soft-0.2", 80.0, 9.0, 9.0)
    with pytest.raises(ValueError, match=r"soft-0.2.json was asked for C = 0.1, its name says 0.2"):
        Results.read(tmp_path)


def test_other_files_are_told_of_and_broken_ones_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path, "run")
    other = run / "evaluations" / "unseen-maps.json"
    other.write_text("{}")
    assert Results.read(tmp_path).skipped == [other]
    (run / "evaluations" / "soft-0.1.json").write_text('{"episodes": 3}')
    with pytest.raises(ValueError, match=r"soft-0.1.json: .*return_mean"):
        Results.read(tmp_path)


def test_a_run_is_a_folder_of_one(tmp_path: Path) -> None:
    """Its bundle, which has a config.json too, is no run of it."""
    run = write_run(tmp_path, "run")
    write_evaluation(run, "soft-0.1", 80.0, 9.0, 9.0)
    write_run(run, "bundle")
    results = Results.read(run)
    assert [one.folder for one in results.runs] == [run]
    assert len(results.measurements) == 1


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no runs, expected <run>/config\.json"):
        Results.read(tmp_path)
