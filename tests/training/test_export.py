"""torch = ONNX = incremental over whole episodes longer than the context, and bundles that verify."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.errors import BadBundle
from tests.training import toy
from training.checkpoint import load_trained
from training.export import ExportConfig, export
from training.train import train
from training.update import TrainState


@pytest.fixture(scope="module")
def bundle(trained: tuple[Path, TrainState], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bundles") / "toy"
    export(ExportConfig(trained[0], out))
    return out


def test_bundle_says_what_was_trained(bundle: Path) -> None:
    manifest = Bundle.load(bundle).manifest
    assert manifest.features == toy.FEATURES
    assert manifest.action == toy.ACTION
    assert (manifest.name, manifest.context_length, manifest.width) == ("toy", 5, 16)
    assert manifest.provenance["trained_budget"] == "0.2"
    assert (bundle / "curves.png").stat().st_size > 10_000
    assert json.loads((bundle / "config.json").read_text())["budget"] == 0.2


def test_served_bots_equal_torch_over_a_whole_episode(trained: tuple[Path, TrainState], bundle: Path) -> None:
    """Two bots, unlimited budgets: what the runtime asks and does each turn, torch computes from the whole past."""
    model = load_trained(trained[0] / "checkpoint.pt").model
    loaded = Bundle.load(bundle)
    turns, n, owner = 4 * loaded.manifest.context_length, 2, loaded.manifest.features.owner
    rng = np.random.default_rng(5)
    free = rng.uniform(0, 1, (turns, n, 2)).astype(np.float32)
    costly = rng.uniform(-1, 1, (turns, n, toy.FEATURES.n_costly)).astype(np.float32)
    rewards = rng.uniform(0, 1, (turns, n)).astype(np.float32)
    bots = Bots(loaded, max_bots=4)
    handles = bots.start(n, seeds=[3, 4], target_returns=[10.0, 20.0], budgets_us=[100.0, 100.0])
    queries, probs, actions = [], [], []
    for t in range(turns):
        asked = bots.request_queries(handles, t, free[t], rewards[t])
        values = np.where(asked.query_NM[:, owner], costly[t], np.float32(0))
        actions.append(bots.submit_features(handles, t, asked.query_NM, values).action_NA)
        queries.append(asked.query_NM)
        probs.append(asked.probs_NM)
    togo = torch.from_numpy(np.array([10.0, 20.0], np.float32) - rewards.cumsum(0)).T[..., None]
    with torch.no_grad():
        query = torch.from_numpy(np.array(queries)).transpose(0, 1).float()
        frames = (torch.from_numpy(free).transpose(0, 1), togo, torch.full_like(togo, 0.2))
        known = model.know(*frames, torch.from_numpy(costly).transpose(0, 1))
        hidden = model.hiddens(known, query)
        expected = model.query_probs(model.memory(hidden), known).transpose(0, 1).numpy()
        expected_actions = model.action_head.actions(hidden, torch.zeros(n, turns, 2)).transpose(0, 1).numpy()
    assert np.abs(np.array(probs) - expected).max() <= 1e-4
    assert np.abs(np.array(actions) - expected_actions).max() <= 1e-4
    assert 0.05 < np.mean(queries) < 0.95


def test_graphs_do_not_tell_where_they_were_made(bundle: Path) -> None:
    for name in ("acquisition.onnx", "action.onnx"):
        assert b".py" not in (bundle / name).read_bytes()


def test_golden_episode_is_longer_than_the_context(bundle: Path) -> None:
    with np.load(bundle / "golden.npz") as golden:
        assert len(golden["free"]) > 2 * 5
        assert golden["queries"].any()


def test_a_bundle_that_does_not_verify_replaces_nothing(
    trained: tuple[Path, TrainState], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import training.export as room

    good = tmp_path / "toy"
    export(ExportConfig(trained[0], good))
    before = {file.name: file.read_bytes() for file in good.iterdir()}
    original = room.golden_episode

    def wrong(*arguments: object) -> dict[str, np.ndarray]:
        golden = original(*arguments)
        return {**golden, "probs": golden["probs"] + np.float32(0.01)}

    monkeypatch.setattr(room, "golden_episode", wrong)
    with pytest.raises(BadBundle):
        export(ExportConfig(trained[0], good))
    assert {file.name: file.read_bytes() for file in good.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["toy"]


def test_forced_acquisition_exports_too(dataset: Path, tmp_path: Path) -> None:
    train(toy.config(dataset, tmp_path / "run", acquisition="all", frame_budget=1.0, updates=2, log_every=1))
    export(ExportConfig(tmp_path / "run", tmp_path / "full"))
    bots = Bots(Bundle.load(tmp_path / "full"), max_bots=1)
    handles = bots.start(1)
    assert bots.request_queries(handles, 0, np.zeros((1, 2), np.float32)).query_NM.all()


@pytest.mark.parametrize("method", ["bdt", "rcbc", "bc", "iql"])
@pytest.mark.parametrize("acquisition", ["learned", "random"])
def test_every_method_exports_to_a_bundle_that_verifies(
    dataset: Path, tmp_path: Path, method: str, acquisition: str
) -> None:
    """`export` loads what it wrote with the runtime's loader, which replays the golden episode."""
    settings = {"method": method, "acquisition": acquisition, "budgets": (0.05, 0.3, 1.0), "budget": 0.25}
    train(toy.config(dataset, tmp_path / "run", updates=3, log_every=1, **settings))
    manifest = export(ExportConfig(tmp_path / "run", tmp_path / "bundle", name="other")).manifest
    assert (manifest.name, manifest.method, manifest.target_cost) == ("other", method, 0.25)
    assert manifest.context_length == (5 if method == "bdt" else 1)
    assert manifest.provenance["trained_budget"] == "conditioned"


def test_a_bundle_can_ask_for_another_cost_than_its_run(dataset: Path, tmp_path: Path) -> None:
    settings = {"budgets": (0.05, 0.3, 1.0), "budget": 0.25, "updates": 2, "log_every": 1}
    train(toy.config(dataset, tmp_path / "run", **settings))
    bundle = export(ExportConfig(tmp_path / "run", tmp_path / "bundle", target_cost=0.1))
    assert bundle.manifest.target_cost == 0.1
    for target_cost in (0.04, float("nan")):
        with pytest.raises(ValueError, match=r"within what was trained, 0\.05 to 1\.0"):
            export(ExportConfig(tmp_path / "run", tmp_path / "bundle", target_cost=target_cost))
    assert Bundle.load(tmp_path / "bundle").manifest.target_cost == 0.1


def test_a_cost_is_not_asked_of_a_run_that_does_not_read_it(trained: tuple[Path, TrainState], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not conditioned"):
        export(ExportConfig(trained[0], tmp_path / "toy", target_cost=0.1))
    with pytest.raises(ValueError, match="expected none with int8"):
        ExportConfig(tmp_path / "toy", tmp_path / "toy-int8", int8=True, target_cost=0.1)


def test_a_served_bot_follows_the_budget_that_the_engine_gives_in_each_frame(dataset: Path, tmp_path: Path) -> None:
    """Random acquisition asks for each feature with probability C: what the graph was told can be read off."""
    settings = {"acquisition": "random", "budgets": (0.05, 1.0), "frame_budget": 1.0, "updates": 2, "log_every": 1}
    train(toy.config(dataset, tmp_path / "run", **settings))
    export(ExportConfig(tmp_path / "run", tmp_path / "bundle"))
    bots = Bots(Bundle.load(tmp_path / "bundle"), max_bots=1)
    handles = bots.start(1)
    full = float(toy.FEATURES.costs_us.sum())
    for frame, share in enumerate((0.1, 0.7, 0.3)):
        asked = bots.request_queries(handles, frame, np.zeros((1, 2), np.float32), target_costs_us=[share * full])
        assert asked.probs_NM == pytest.approx(share, abs=1e-6)


def test_only_a_bundle_or_nothing_is_replaced(trained: tuple[Path, TrainState], tmp_path: Path) -> None:
    notes = tmp_path / "notes"
    notes.mkdir()
    (notes / "mine.txt").write_text("kept")
    with pytest.raises(ValueError, match="is there and is no bundle"):
        export(ExportConfig(trained[0], notes))
    assert (notes / "mine.txt").read_text() == "kept"
    (notes / "mine.txt").unlink()
    for _ in range(2):  # into an empty folder, then in place of what came of that
        assert export(ExportConfig(trained[0], notes)).manifest.name == "toy"
