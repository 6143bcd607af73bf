"""Evaluation plays the bundle through the runtime, and sees no more than it asked for."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from game.env import ACTION_SPEC, feature_table
from tests.bundles import make_bundle
from training.evaluate import EvaluateConfig, evaluate

ENVIRONMENT = "game.env:Navigation-hard-v0"


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_bundle(tmp_path_factory.mktemp("bundles") / "random", features=feature_table(), action=ACTION_SPEC)


def test_hard_cost_stays_within_the_budget_where_the_soft_one_does_not(bundle: Path) -> None:
    config = EvaluateConfig(bundle, ENVIRONMENT, episodes=3, budget=0.1, workers=1)
    evaluation, episodes = evaluate(config)
    assert evaluation.violations == 0
    assert evaluation.hard_cost_pct <= 10.0 < evaluation.soft_cost_pct
    assert [episode.seed for episode in episodes] == [1_000_000, 1_000_001, 1_000_002]
    assert evaluation.return_mean == pytest.approx(sum(episode.total for episode in episodes) / 3)


def test_outcome_depends_neither_on_workers_nor_on_batches(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = EvaluateConfig(bundle, ENVIRONMENT, episodes=4, budget=0.05, workers=1)
    together = evaluate(config)[1]
    monkeypatch.setattr("training.evaluate._CHUNK", 2)
    apart = evaluate(dataclasses.replace(config, workers=2))[1]
    assert [(e.seed, e.frames, e.total) for e in together] == [(e.seed, e.frames, e.total) for e in apart]


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


@pytest.mark.parametrize("settings", [{"episodes": 0}, {"workers": 0}, {"budget": 1.5}, {"budget": float("nan")}])
def test_refuses_settings_that_cannot_be(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        EvaluateConfig(Path("nowhere"), **settings)
