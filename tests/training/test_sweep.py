"""Sweeps in processes of their own: runs end in bundles and evaluations, go on where they stopped, and fail alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from bot_runtime.bundle import Bundle
from tests.training.sweeps import write_spec
from tests.training.toy_game import TOY
from training import sweep_run
from training.config import TrainConfig
from training.heat_map import HeatMap
from training.sweep import Outcome, SweepConfig, main, sweep
from training.sweep_spec import SweepSpec

pytestmark = pytest.mark.timeout(300)  # each run imports torch and exports: long on a busy machine

EVALUATE: dict[str, object] = {"episodes": 3, "heat_map": 0.2}
DONE = ["bdt-learned-test-v0-c0_2-s0", "bdt-all-test-v0-s0"]
BROKEN = "bdt-learned-nothing-v0-c0_1-s0"


@pytest.fixture(scope="module")
def spec(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs, the middle one on a dataset that is not there."""
    grid: list[dict[str, object]] = [
        {"environment": TOY, "budget": [0.2]},
        {"dataset": str(dataset.parent / "nothing-v0")},
        {"environment": TOY, "acquisition": ["all"], "evaluate": {"heat_map": None}},
    ]
    return write_spec(tmp_path_factory.mktemp("sweep"), dataset, grid, EVALUATE)


@pytest.fixture(scope="module")
def outcomes(spec: Path) -> list[Outcome]:
    return sweep(SweepConfig(spec, workers=2, threads=1))


@pytest.fixture
def results(spec: Path, outcomes: list[Outcome]) -> Path:
    return spec.parent / "results"


def files(folder: Path) -> dict[str, int]:
    """When every file was last written, but for the log."""
    return {
        str(path): path.stat().st_mtime_ns for path in folder.rglob("*") if path.name not in ("log.txt", "sweep.json")
    }


def test_a_run_that_fails_says_why_and_stops_no_other(outcomes: list[Outcome], results: Path) -> None:
    assert [(outcome.run.name, outcome.state) for outcome in outcomes] == [
        (DONE[0], "done"),
        (BROKEN, "failed"),
        (DONE[1], "done"),
    ]
    assert "nothing-v0" in outcomes[1].reason
    log = (results / BROKEN / "log.txt").read_text()
    assert "Traceback (most recent call last)" in log
    assert log.strip().endswith(outcomes[1].reason)


def test_a_run_leaves_all_its_parts(results: Path) -> None:
    run = results / DONE[0]
    assert Bundle.load(run / "bundle").name == DONE[0]
    assert TrainConfig.read(run / "config.json").budget == 0.2
    assert [json.loads(line)["update"] for line in (run / "metrics.jsonl").read_text().splitlines()] == [2, 4]
    assert {path.name for path in (run / "evaluations").iterdir()} == {"soft-0.2.json", "hard-0.2.json"}
    assert {path.name for path in (results / DONE[1] / "evaluations").iterdir()} == {"soft-1.json"}
    assert not list(results.rglob("*.partial"))
    assert not (results / DONE[1] / "heat_map.npz").exists()
    heat_map = HeatMap.read(run / "heat_map.npz")
    assert heat_map.names == ("left", "right", "noise", "dear")
    assert heat_map.alive_T.tolist() == [3] * 8


def test_evaluations_were_played_under_what_their_labels_say(results: Path) -> None:
    def evaluation(run: str, label: str) -> dict[str, object]:
        return json.loads((results / run / "evaluations" / f"{label}.json").read_text())

    soft, hard = evaluation(DONE[0], "soft-0.2"), evaluation(DONE[0], "hard-0.2")
    assert (soft["budget"], soft["frame_budget"], hard["budget"], hard["frame_budget"]) == (1.0, None, 1.0, 0.2)
    assert hard["hard_cost_pct"] <= 20.0
    assert hard["violations"] == 0
    assert len(soft["returns"]) == soft["episodes"] == 3
    assert evaluation(DONE[1], "soft-1")["hard_cost_pct"] == pytest.approx(100.0)


def test_says_what_was_asked_beside_the_runs(spec: Path, results: Path) -> None:
    about = json.loads((results / "sweep.json").read_text())
    assert about["spec"] == json.loads(spec.read_text())
    assert about["runs"] == [DONE[0], BROKEN, DONE[1]]
    assert {"torch", "onnxruntime", "python"} <= set(about["versions"])


def test_what_is_done_is_not_done_again(spec: Path, results: Path) -> None:
    before = files(results)
    again = sweep(SweepConfig(spec, workers=2, threads=1))
    assert [outcome.state for outcome in again] == ["done before", "failed", "done before"]
    assert files(results) == before


def test_only_an_evaluation_that_is_missing_is_played(spec: Path, results: Path) -> None:
    lost = results / DONE[0] / "evaluations" / "hard-0.2.json"
    before, played = files(results / DONE[0]), lost.read_text()
    lost.unlink()
    (outcome,) = sweep(SweepConfig(spec, threads=1, only="*-c0_2-*"))
    assert outcome.state == "done"
    assert lost.read_text() == played
    written = {Path(path).name for path, when in files(results / DONE[0]).items() if before[path] != when}
    assert written == {"evaluations", "hard-0.2.json", "done.json"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"base": {"learning_rate": 0.5}}, "made with learning_rate 0.002, the sweep has 0.5: delete it"),
        ({"base": {"updates": 5}}, "made with updates 4, the sweep has 5"),
        ({"evaluate": {"episodes": 4}}, r"soft-0.2.json was made with episodes 3, the sweep has 4"),
    ],
)
def test_other_settings_for_a_folder_are_refused(
    spec: Path, results: Path, tmp_path: Path, change: dict[str, dict[str, object]], message: str
) -> None:
    data = json.loads(spec.read_text())
    other = tmp_path / "spec.json"
    other.write_text(json.dumps(data | {part: data[part] | settings for part, settings in change.items()}))
    before = files(results)
    with pytest.raises(ValueError, match=message):
        sweep(SweepConfig(other))
    assert files(results) == before


@pytest.mark.parametrize("name", ["done.json", "evaluations/soft-0.2.json"])
def test_a_broken_file_is_named(spec: Path, results: Path, name: str) -> None:
    file = results / DONE[0] / name
    whole = file.read_bytes()
    for broken in (whole[:9], b"{}"):
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=rf"{file} is broken, delete it and it is made again"):
            sweep(SweepConfig(spec))
    file.write_bytes(whole)


def test_a_dry_run_lists_and_does_nothing(
    spec: Path, results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    before = files(results)
    main([str(spec), "--dry-run"])
    lines = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()}
    assert lines[DONE[0]][:3] == ["done", "before", "4/4"]
    assert lines[BROKEN][:2] == ["begun", "0/4"]
    assert files(results) == before


def test_command_line_exits_as_the_runs_did(
    spec: Path, results: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "400")
    main([str(spec), "--only", "*-all-*"])
    with pytest.raises(SystemExit) as end:
        main([str(spec), "--only", "*nothing*"])
    assert end.value.code == 1
    assert str(results / BROKEN / "log.txt") in capsys.readouterr().out
    with pytest.raises(SystemExit, match="error: no run matches 'x', there are bdt-learned"):
        main([str(spec), "--only", "x"])


@pytest.mark.parametrize(
    "settings", [{"workers": 0}, {"threads": 0}, {"gpus_per_run": -1.0, "ray": "local"}, {"gpus_per_run": 0.1}]
)
def test_refuses_settings_that_cannot_be(settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="expected"):
        SweepConfig(Path("spec.json"), **settings)


@pytest.fixture
def endless(dataset: Path, tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], Path]]:
    """A sweep of one long run, which has made its first checkpoint; and the run's folder."""
    spec = write_spec(tmp_path, dataset, [{}], updates=10**6, checkpoint_every=1)
    (run,) = SweepSpec.read(spec).runs()
    process = subprocess.Popen([sys.executable, "-m", "training.sweep", str(spec)], stdout=subprocess.DEVNULL)
    try:
        while not (run.config.out / "checkpoint.pt").exists():
            assert process.poll() is None
            time.sleep(0.05)
        yield process, run.config.out
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGKILL])
def test_no_run_outlives_its_sweep(
    endless: tuple[subprocess.Popen[bytes], Path], sign: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log is locked for as long as a process of the run lives."""
    process, out = endless
    with (out / "log.txt").open("ab") as log:
        monkeypatch.setattr(sweep_run, "_LOCK_S", 0.0)
        assert not sweep_run._lock(log)
        os.kill(process.pid, sign)
        assert process.wait(20) != 0
        monkeypatch.setattr(sweep_run, "_LOCK_S", 20.0)
        assert sweep_run._lock(log)
    assert TrainConfig.read(out / "config.json").updates == 10**6


def test_two_sweeps_do_not_write_one_folder(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_run, "_LOCK_S", 0.0)
    spec = write_spec(tmp_path, dataset, [{}])
    (run,) = SweepSpec.read(spec).runs()
    run.config.out.mkdir(parents=True)
    with (run.config.out / "log.txt").open("ab") as log:
        assert sweep_run._lock(log)
        (outcome,) = sweep(SweepConfig(spec))
    assert (outcome.state, outcome.reason) == ("failed", f"another process is at work in {run.config.out}")


def test_a_run_that_is_killed_is_reported(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by a system out of memory."""
    spec = write_spec(tmp_path, dataset, [{}], updates=10**6)
    tell = sweep_run._tell

    def tell_and_kill(process: subprocess.Popen[bytes], run: sweep_run.Run, threads: int) -> None:
        tell(process, run, threads)
        process.kill()

    monkeypatch.setattr(sweep_run, "_tell", tell_and_kill)
    (outcome,) = sweep(SweepConfig(spec))
    assert (outcome.state, outcome.reason) == ("failed", "killed by SIGKILL")


def test_a_new_setting_at_its_default_changes_no_old_run(dataset: Path, tmp_path: Path) -> None:
    (run,) = SweepSpec.read(write_spec(tmp_path, dataset, [{}])).runs()
    run.config.out.mkdir(parents=True)
    run.config.write(run.config.out / "config.json")
    old = msgspec.json.decode((run.config.out / "config.json").read_bytes())
    del old["control"]
    (run.config.out / "config.json").write_bytes(msgspec.json.encode(old))
    assert run.state() == "begun"
