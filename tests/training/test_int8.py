"""From a bundle to its int8 twin: it verifies, it is near, it says what it is and what was lost."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import training.export
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from tests.training import toy
from tests.training.toy_game import TOY
from training.export import ExportConfig, export
from training.int8 import Int8, Int8Report, export_int8, report_lines
from training.replayed import replayed
from training.train import train

EPISODES = 3


@pytest.fixture(scope="module")
def source(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Wide enough for a large product: 64 x 192 and 64 x 257 in its one block."""
    folder = tmp_path_factory.mktemp("wide")
    settings = {"width": 64, "n_layers": 1, "updates": 20, "budgets": (0.1, 0.5, 1.0), "budget": 0.5}
    train(toy.config(dataset, folder / "run", **settings))
    export(ExportConfig(folder / "run", folder / "wide", name="wide"))
    return folder / "wide"


@pytest.fixture(scope="module")
def made(source: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Int8Report]:
    out = tmp_path_factory.mktemp("int8") / "small"
    return out, export_int8(Int8(source, out, episodes=EPISODES, environment=TOY))[1]


def test_verifies_and_says_what_it_is(source: Path, made: tuple[Path, Int8Report]) -> None:
    before, after = Bundle.load(source), Bundle.load(made[0])
    assert (after.name, after.manifest.precision) == ("wide-int8", "int8")
    assert after.manifest.provenance["quantised_from"] == f"wide {before.sha256}"
    assert after.manifest.features == before.manifest.features
    assert after.acquisition == before.acquisition
    assert len(after.action) < len(before.action)
    assert (made[0] / "config.json").read_bytes() == (source / "config.json").read_bytes()


def test_its_golden_episode_is_its_own(source: Path, made: tuple[Path, Int8Report]) -> None:
    before, after = Bundle.load(source), Bundle.load(made[0])
    golden = read_golden((made[0] / "golden.npz").read_bytes(), after.manifest)
    own = replayed(after, golden)
    assert (own.queries_TM == golden["queries"]).all()
    assert own.probs_TM == pytest.approx(golden["probs"], abs=1e-6)
    assert own.actions_TA == pytest.approx(golden["actions"], abs=1e-6)
    other = replayed(before, golden, golden["queries"].astype(np.bool_))
    assert 1e-6 < np.abs(other.hidden_TW - own.hidden_TW).max() < 0.5


def test_says_what_was_lost(made: tuple[Path, Int8Report]) -> None:
    out, report = made
    assert report == dataclasses.replace(report, source="wide", turns=len(np.load(out / "golden.npz")["free"]))
    assert 0.0 < report.probs_mean <= report.probs_max < 0.1
    assert 0.0 <= report.action_mean <= report.action_max
    assert report.flips_pct <= 5.0
    assert report.int8_bytes < report.fp32_bytes
    returns, recorded = report.returns, json.loads((out / "evaluation.json").read_text())
    assert returns is not None
    assert (returns.environment, returns.episodes) == (TOY, EPISODES)
    assert recorded["return_mean"] == returns.int8_mean
    assert returns.lost_pct == pytest.approx(100.0 * (1.0 - returns.int8_mean / returns.fp32_mean))
    written = json.loads((out / "int8.json").read_text())
    assert written["returns"]["fp32_mean"] == returns.fp32_mean
    assert any("return over 3 episodes" in line for line in report_lines(report))


def test_command_line(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = [str(source), str(tmp_path / "small"), "--int8", "--name", "other"]
    monkeypatch.setattr(sys, "argv", ["export", *arguments])
    training.export.main()
    assert Bundle.load(tmp_path / "small").name == "other"
    report = json.loads((tmp_path / "small" / "int8.json").read_text())
    assert report["command"] == f"python -m training.export {' '.join(arguments)}"
    assert report["returns"] is None


def test_int8_is_not_made_of_int8(made: tuple[Path, Int8Report], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="is int8, expected a float32 bundle"):
        export_int8(Int8(made[0], tmp_path / "again"))
    assert not list(tmp_path.iterdir())


def test_a_network_of_small_products_has_no_int8(dataset: Path, tmp_path: Path) -> None:
    train(toy.config(dataset, tmp_path / "run", updates=2, log_every=1))
    export(ExportConfig(tmp_path / "run", tmp_path / "toy"))
    with pytest.raises(ValueError, match="no matrix product that is large enough"):
        export_int8(Int8(tmp_path / "toy", tmp_path / "small"))
    assert not (tmp_path / "small").exists()
