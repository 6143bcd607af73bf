"""Evaluation plays the bundle through the runtime, and sees no more than it asked for."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from game.env import ACTION_SPEC, feature_table
from tests.bundles import make_bundle
from tests.training.line import LINE
from training.evaluate import EvaluateConfig, _frame_mean_pct, _normalised, evaluate, main
from training.heat_map import HeatMap
from training.play import Episode

ENVIRONMENT = "game.env:Navigation-hard-v0"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "random", features=feature_table(), action=ACTION_SPEC)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")


def test_hard_cost_stays_within_the_budget_where_the_soft_one_does_not(bundle: Path) -> None:
    config = EvaluateConfig(bundle, ENVIRONMENT, episodes=3, budget=0.1, workers=1)
    evaluation, episodes = evaluate(config)
    assert evaluation.violations == 0
    assert evaluation.hard_cost_pct <= 10.0 < evaluation.soft_cost_pct
    assert [episode.seed for episode in episodes] == [1_000_000, 1_000_001, 1_000_002]
    assert evaluation.return_mean == pytest.approx(sum(episode.total for episode in episodes) / 3)


def test_outcome_depends_neither_on_workers_nor_on_batches(bundle: Path) -> None:
    config = EvaluateConfig(bundle, ENVIRONMENT, episodes=5, budget=0.05, workers=1)
    together = evaluate(config)[1]
    apart = evaluate(dataclasses.replace(config, workers=2, bots=1))[1]
    assert [(e.seed, e.frames, e.total) for e in together] == [(e.seed, e.frames, e.total) for e in apart]


def test_a_shared_budget_depends_on_who_plays_together_but_never_on_workers(tiny: Path, tmp_path: Path) -> None:
    config = EvaluateConfig(tiny, LINE, episodes=20, frame_budget=0.1, bots=2, workers=1)
    outcomes = []
    for workers in (1, 2):
        heat_map = tmp_path / f"{workers}.npz"
        outcomes.append(evaluate(dataclasses.replace(config, workers=workers, heat_map=heat_map)))
    assert outcomes[0] == outcomes[1]
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    evaluation = outcomes[0][0]
    assert (evaluation.budget, evaluation.frame_budget, evaluation.bots) == (1.0, 0.1, 2)
    assert evaluation.violations == 0
    assert evaluation.hard_cost_pct <= 10.0 < evaluation.soft_cost_pct
    assert HeatMap.read(tmp_path / "1.npz").alive_T[0] == 20


def test_says_what_was_trained_and_what_was_asked_for(tiny: Path) -> None:
    evaluation, _ = evaluate(EvaluateConfig(tiny, LINE, episodes=2, workers=1))
    assert (evaluation.method, evaluation.target_cost, evaluation.frame_budget) == ("bdt", None, None)
    assert (evaluation.trained_budget, evaluation.train_seed, evaluation.budget) == (None, None, 0.5)


def test_provenance_is_handed_on(tiny: Path, tmp_path: Path) -> None:
    bundle = tmp_path / "bundle"
    shutil.copytree(tiny, bundle)
    manifest = json.loads((bundle / "manifest.json").read_text())
    origin = {"environment": LINE, "dataset": "hard-expert-v0", "seed": "3", "trained_budget": "0.1"}
    manifest["provenance"] = {**origin, "acquisition": "learned"}
    (bundle / "manifest.json").write_text(json.dumps(manifest))
    evaluation, _ = evaluate(EvaluateConfig(bundle, episodes=2, workers=1))
    assert (evaluation.environment, evaluation.dataset, evaluation.acquisition) == (LINE, "hard-expert-v0", "learned")
    assert (evaluation.train_seed, evaluation.trained_budget) == (3, 0.1)


def test_a_conditioned_bundle_is_asked_for_its_own_target_cost_or_for_another(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "conditioned", target_cost=0.25)
    config = EvaluateConfig(bundle, LINE, episodes=4, budget=1.0, workers=1)
    asked = {}
    for target_cost in (None, 0.25, 0.9):
        evaluation, _ = evaluate(dataclasses.replace(config, target_cost=target_cost))
        asked[target_cost] = evaluation.soft_cost_pct
        assert evaluation.target_cost == (target_cost or 0.25)
    assert asked[None] == asked[0.25] != asked[0.9]


def test_another_return_can_be_asked_for_than_the_bundles(tiny: Path) -> None:
    config = EvaluateConfig(tiny, LINE, episodes=4, budget=1.0, workers=1)
    own = json.loads((tiny / "manifest.json").read_text())["target_return"]
    asked = {}
    for target_return in (None, own, own + 50.0):
        evaluation, _ = evaluate(dataclasses.replace(config, target_return=target_return))
        asked[target_return] = evaluation.soft_cost_pct
        assert evaluation.target_return == (own if target_return is None else target_return)
    assert asked[None] == asked[own] != asked[own + 50.0]


def test_a_target_cost_is_refused_by_a_bundle_that_is_not_conditioned(tiny: Path) -> None:
    with pytest.raises(ValueError, match=r"target_cost is 0.1, expected none: tiny is not conditioned"):
        evaluate(EvaluateConfig(tiny, LINE, target_cost=0.1))


def test_command_line_writes_what_it_prints(bundle: Path, tmp_path: Path) -> None:
    out = tmp_path / "evaluation.json"
    command = [sys.executable, "-m", "training.evaluate", str(bundle), "--environment", ENVIRONMENT]
    command += ["--episodes", "2", "--workers", "1", "--out", str(out)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    printed = json.loads(done.stdout.splitlines()[-1])
    written = json.loads(out.read_text())
    assert len(written.pop("returns")) == 2
    assert written == printed


def test_a_bundle_without_an_environment_needs_one(bundle: Path) -> None:
    with pytest.raises(ValueError, match="names no environment"):
        evaluate(EvaluateConfig(bundle, episodes=1))


@pytest.mark.parametrize(
    "settings",
    [
        {"episodes": 0},
        {"workers": 0},
        {"bots": 0},
        {"budget": 1.5},
        {"budget": float("nan")},
        {"target_cost": -0.1},
        {"frame_budget": 1.01},
        {"target_return": float("inf")},
    ],
)
def test_refuses_settings_that_cannot_be(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        EvaluateConfig(Path("nowhere"), **settings)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_evaluation_that_is_stopped_stops_with_all_that_play(number: signal.Signals) -> None:
    """Its workers hold its standard error; when nobody does any more, it ends."""
    bundle = Path(__file__).parents[2] / "bundles" / "easy"
    command = [sys.executable, "-m", "training.evaluate", str(bundle), "--episodes", "20000", "--workers", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, cwd=bundle.parents[1]) as running:
        assert running.stderr is not None
        said = b""
        while said.count(b"pybullet build time") < 2:  # both that play have begun
            part = os.read(running.stderr.fileno(), 4096)
            assert part, said
            said += part
        running.send_signal(number)
        said += running.communicate(timeout=60)[1]
    assert running.returncode == {signal.SIGINT: 1, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    assert b"Traceback" not in said


def test_a_cost_is_a_mean_over_frames_and_not_over_episodes() -> None:
    short = Episode(seed=0, total=1.0, frames=1, soft_cost=1.0, hard_cost=0.5, violations=0, terminated=True)
    long = dataclasses.replace(short, seed=1, frames=9, soft_cost=0.0, hard_cost=0.0)
    assert _frame_mean_pct([short, long], "soft_cost") == pytest.approx(10.0)
    assert _frame_mean_pct([short, long], "hard_cost") == pytest.approx(5.0)


def test_a_standard_error_is_that_of_a_sample(tiny: Path) -> None:
    evaluation, episodes = evaluate(EvaluateConfig(tiny, LINE, episodes=5, workers=1))
    assert evaluation.return_stderr == pytest.approx(statistics.stdev(one.total for one in episodes) / 5**0.5)
    assert evaluate(EvaluateConfig(tiny, LINE, episodes=1, workers=1))[0].return_stderr is None


def test_a_broken_feature_map_is_named(tiny: Path, tmp_path: Path) -> None:
    bundle = tmp_path / "tiny"
    shutil.copytree(tiny, bundle)
    (bundle / "feature_map.json").write_text('{"features": [')
    with pytest.raises(ValueError, match=r"feature_map\.json: Input data was truncated"):
        evaluate(EvaluateConfig(bundle, LINE, episodes=1, workers=1))


def test_d4rls_score_is_0_and_100_at_its_references() -> None:
    references = "-280.178953 12135.0"
    assert _normalised(-280.178953, references) == pytest.approx(0.0)
    assert _normalised(12135.0, references) == pytest.approx(100.0)
    assert _normalised(1.0, None) is None


def test_a_record_of_before_is_replaced_only_where_it_is_named(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle = tmp_path / "tiny"
    shutil.copytree(tiny, bundle)
    (bundle / "evaluation.json").write_text("of 256 episodes")
    asked = [str(bundle), "--environment", LINE, "--episodes", "2", "--workers", "1"]
    main(asked)
    assert (bundle / "evaluation.json").read_text() == "of 256 episodes"
    assert "stays as it is" in capsys.readouterr().err
    main([*asked, "--out", str(bundle / "evaluation.json")])
    assert json.loads((bundle / "evaluation.json").read_text())["episodes"] == 2
