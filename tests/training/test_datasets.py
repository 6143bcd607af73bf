"""Datasets that know nothing of this project: opened by a feature map, trained on, exported and played as a bundle."""

from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer
from rich.console import Console

from tests.training.balance import CARTPOLE, write_cartpole
from tests.training.logs import COLUMNS, rows, write_csv
from training.config import TrainConfig
from training.datasets import TracesError, observation_sizes, open_dataset
from training.draft_map import DraftConfig, draft_map
from training.environments import open_environment
from training.evaluate import EvaluateConfig, evaluate
from training.export import ExportConfig, export
from training.feature_map import FeatureMap, MappedFeature
from training.import_traces import ImportConfig, import_traces
from training.traces import load_traces
from training.train import train

MAP = FeatureMap(
    (
        MappedFeature("place", (0, 2)),
        MappedFeature("speeds", (1, 3), cost_us=5.0, group="exact"),
        MappedFeature("rough_speeds", (1, 3), cost_us=1.0, noise=0.2, group="rough"),
    )
)


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as monkeypatch:
        return write_cartpole(tmp_path_factory.mktemp("datasets"), monkeypatch)


def test_a_map_finds_the_features(cartpole: Path) -> None:
    dataset = open_dataset(cartpole, MAP)
    recorded, read = minari.MinariDataset(cartpole / "data")[3], dataset.episode(3)
    np.testing.assert_array_equal(read.free_TF, recorded.observations[:-1, [0, 2]])
    np.testing.assert_array_equal(read.costly_TD[:, :2], recorded.observations[:-1, [1, 3]])
    assert read.actions_TA.tolist() == recorded.actions[:, None].tolist()
    assert dataset.choices == 2
    assert [(one.name, one.low, one.high) for one in dataset.action.components] == [("choice", 0.0, 1.0)]
    np.testing.assert_array_equal(dataset.episode(3).costly_TD, read.costly_TD)  # noise is drawn once


def test_an_id_is_found_where_minari_keeps_it(cartpole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(cartpole.parents[1]))
    assert len(open_dataset(Path("cartpole/test-v0"), MAP)) == 12
    with pytest.raises(TracesError, match="minari download cartpole/other-v0"):
        open_dataset(Path("cartpole/other-v0"), MAP)


def test_a_dataset_that_tells_no_features_needs_a_map(cartpole: Path) -> None:
    assert observation_sizes(cartpole) == {"": 4}
    with pytest.raises(TracesError, match="tells no features: give a feature map"):
        load_traces(cartpole)
    with pytest.raises(TracesError, match="has number 7, the observation has 0 to 3"):
        load_traces(cartpole, feature_map=FeatureMap((MappedFeature("a", (7,)),)))


@pytest.mark.parametrize(
    ("key", "space", "message"),
    [
        ("action_space", {"type": "Discrete", "n": 3}, "there is no 'start'"),
        ("observation_space", {"type": "Text"}, "is a Text, expected numbers or a Dict"),
        ("observation_space", [], r"found '\[\]', expected an object"),
        ("action_space", {"type": "MultiDiscrete", "nvec": [2, 2]}, "expected Discrete or a flat Box"),
        ("action_space", {"type": "Box", "shape": [1], "low": [float("-inf")], "high": [1.0]}, "expected finite"),
    ],
)
def test_refuses_spaces_that_it_cannot_serve(
    cartpole: Path, tmp_path: Path, key: str, space: object, message: str
) -> None:
    metadata = json.loads((cartpole / "data" / "metadata.json").read_text())
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "metadata.json").write_text(json.dumps(metadata | {key: json.dumps(space)}))
    with pytest.raises(TracesError, match=message):
        open_dataset(tmp_path, MAP)


def test_several_datasets_are_read_in_turn(cartpole: Path) -> None:
    alone, twice = load_traces(cartpole, feature_map=MAP), load_traces(cartpole, cartpole, episodes=2, feature_map=MAP)
    assert twice.lengths_E.tolist() == [60, 60, 60, 60]
    assert (twice.free_SF[:60] == twice.free_SF[60:120]).all()
    assert (twice.free_SF[120:180] == alone.free_SF[60:120]).all()


def test_refuses_datasets_with_other_actions(cartpole: Path, tmp_path: Path) -> None:
    other = tmp_path / "other-v0"
    shutil.copytree(cartpole, other)
    file = other / "data" / "metadata.json"
    metadata = json.loads(file.read_text())
    space = {"type": "Discrete", "dtype": "int64", "n": 3, "start": 0}
    file.write_text(json.dumps(metadata | {"action_space": json.dumps(space)}))
    with pytest.raises(TracesError, match="have other features or other actions"):
        load_traces(cartpole, other, feature_map=MAP)


def test_a_bundle_of_another_environment_is_played_through_the_runtime(cartpole: Path, tmp_path: Path) -> None:
    MAP.write(tmp_path / "map.json")
    config = TrainConfig(
        dataset=cartpole, out=tmp_path / "run", name="pole", environment=CARTPOLE, feature_map=tmp_path / "map.json",
        reference_returns=(0.0, 500.0), bins=(2,), budget=0.5, frame_budget=1.0, fourier=0, context_length=5, window=20,
        width=16, n_heads=2, encoder_width=32, batch=32, updates=60, learning_rate=5e-3, log_every=20,
    )  # fmt: skip
    train(config)
    bundle = export(ExportConfig(tmp_path / "run", tmp_path / "pole"))
    assert [feature.name for feature in bundle.manifest.features.costly] == ["speeds", "rough_speeds"]
    evaluation, episodes = evaluate(EvaluateConfig(tmp_path / "pole", episodes=6, workers=1))
    assert evaluation.return_mean > 60.0, "a random player lasts for 22 steps"
    assert evaluation.normalised_mean == pytest.approx(evaluation.return_mean / 5.0)
    assert set(evaluation.acquired_pct) == {"exact", "rough"}
    spent = (5.0 * evaluation.acquired_pct["exact"] + evaluation.acquired_pct["rough"]) / 6.0
    assert evaluation.hard_cost_pct == pytest.approx(spent)
    assert {episode.violations for episode in episodes} == {0}


def test_what_is_played_has_noise_that_follows_the_episode() -> None:
    features = MAP.table({"": 4})
    first, second = open_environment(CARTPOLE, features, MAP), open_environment(CARTPOLE, features, MAP)
    asked = np.array([True, True])
    for env in (first, second):
        env.restart(5)
    np.testing.assert_array_equal(first.acquire(asked), second.acquire(asked))
    exact, rough = first.acquire(asked)[:2], first.acquire(asked)[2:]
    assert not np.array_equal(exact, rough)
    state = gymnasium.make(CARTPOLE).reset(seed=5)[0]
    np.testing.assert_array_equal(first.free(), state[[0, 2]])
    assert first.advance(np.array([1.0], np.float32)).reward == 1.0


def test_a_draft_has_every_number_and_its_copies(cartpole: Path, tmp_path: Path) -> None:
    plain = draft_map(DraftConfig(cartpole, tmp_path / "map.json", cost_us=2.5))
    assert [(one.name, one.numbers, one.cost_us) for one in plain.features][:2] == [
        ("number_0", (0,), 2.5),
        ("number_1", (1,), 2.5),
    ]
    copies = ("exact:20:0", "low:5:0.1")
    drafted = draft_map(DraftConfig(cartpole, tmp_path / "map.json", names=("x", "v", "angle", "spin"), copies=copies))
    assert [one.name for one in drafted.features][3:5] == ["spin_exact", "x_low"]
    recorded = np.concatenate([episode.observations[:-1] for episode in minari.MinariDataset(cartpole / "data")])
    noise = [one.noise for one in drafted.features if one.group == "low"]
    assert noise == pytest.approx((0.1 * recorded.std(axis=0)).tolist(), rel=1e-3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"names": ("x",)}, "names are 1, the observation has 4 numbers"),
        ({"copies": ("exact:20",)}, "copy 'exact:20' is not group:cost_us:noise"),
    ],
)
def test_a_draft_refuses(cartpole: Path, tmp_path: Path, settings: dict[str, tuple[str, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draft_map(DraftConfig(cartpole, tmp_path / "map.json", **settings))


def test_a_draft_overwrites_nothing(cartpole: Path, tmp_path: Path) -> None:
    (tmp_path / "map.json").write_text("mine")
    with pytest.raises(ValueError, match=r"map\.json exists"):
        DraftConfig(cartpole, tmp_path / "map.json")


def test_an_observation_may_have_parts_that_are_no_boxes(tmp_path: Path) -> None:
    """A mission in words and a nested Dict stand beside numbers of every kind; the map names numbers alone."""
    spaces = gymnasium.spaces
    observed = spaces.Dict(
        {
            "view": spaces.Box(-1.0, 1.0, (2, 2)),
            "direction": spaces.Discrete(4),
            "keys": spaces.MultiBinary(3),
            "bag": spaces.MultiDiscrete([5, 7]),
            "mission": spaces.Text(8),
            "inner": spaces.Dict({"hidden": spaces.Box(-1.0, 1.0)}),
        }
    )
    observed.seed(0)
    seen = [observed.sample() for _ in range(4)]
    buffer = EpisodeBuffer(
        observations={
            **{key: np.array([one[key] for one in seen]) for key in ("view", "direction", "keys", "bag")},
            "mission": [one["mission"] for one in seen],
            "inner": {"hidden": np.array([one["inner"]["hidden"] for one in seen])},
        },
        actions=np.zeros(3, np.int64),
        rewards=[0.0, 1.0, 2.0],
        terminations=[False, False, True],
        truncations=[False] * 3,
    )
    with pytest.MonkeyPatch.context() as monkeypatch, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        minari.create_dataset_from_buffers(
            "parts/test-v0", [buffer], observation_space=observed, action_space=spaces.Discrete(2)
        )
    folder = tmp_path / "parts" / "test-v0"
    assert observation_sizes(folder) == {"bag": 2, "direction": 1, "keys": 3, "view": 4}
    chosen = FeatureMap(
        (
            MappedFeature("direction", key="direction"),
            MappedFeature("bag", key="bag"),
            MappedFeature("view", key="view"),
        )
    )
    read = open_dataset(folder, chosen).episode(0)
    np.testing.assert_array_equal(read.free_TF[:, 0], [one["direction"] for one in seen[:3]])
    np.testing.assert_array_equal(read.free_TF[:, 1:3], [one["bag"] for one in seen[:3]])
    np.testing.assert_array_equal(read.free_TF[:, 3:], [one["view"].ravel() for one in seen[:3]])
    with pytest.raises(TracesError, match=r"has key 'mission', expected one of \['bag', 'direction', 'keys', 'view'\]"):
        open_dataset(folder, FeatureMap((MappedFeature("mission", key="mission"),)))


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (
            (MappedFeature("a", (0,), low=-0.01, high=0.01), MappedFeature("b", (1,), cost_us=1.0)),
            "a is .* at timestep",
        ),
        (
            (MappedFeature("a", (0,)), MappedFeature("b", (1, 2), cost_us=1.0, low=5.0, high=6.0)),
            "b is .* expected 5 to 6",
        ),
    ],
)
def test_numbers_that_a_server_would_refuse_are_not_learned(
    cartpole: Path, features: tuple[MappedFeature, ...], message: str
) -> None:
    with pytest.raises(TracesError, match=f"episode .*: {message}"):
        load_traces(cartpole, feature_map=FeatureMap(features))


def test_noise_keeps_within_the_range(cartpole: Path) -> None:
    noisy = FeatureMap((MappedFeature("a", (0, 1, 2, 3), cost_us=1.0, noise=100.0, low=-3.1, high=3.1),))
    costly_TD = open_dataset(cartpole, noisy).episode(0).costly_TD
    assert np.abs(costly_TD).max() == np.float32(3.1)
    assert load_traces(cartpole, feature_map=noisy).layout.features.n_costly == 4


def test_a_draft_of_parts_has_names_that_training_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_csv(tmp_path / "log.csv", rows(3, 2))
    columns = {**COLUMNS, "observations": {"Body": ["health"], "x2_Y": ["speed"]}}
    del columns["observation"]
    (tmp_path / "columns.json").write_text(json.dumps(columns))
    out = tmp_path / "arena-v0"
    import_traces(ImportConfig(tmp_path / "log.csv", out, tmp_path / "columns.json"), Console(quiet=True))
    drafted = draft_map(DraftConfig(out, tmp_path / "map.json"))
    assert [one.name for one in drafted.features] == ["body_0", "x2_y_0"]
    assert load_traces(out, feature_map=drafted).layout.features.n_queries == 2
    for wrong in ({"cost_us": -1.0}, {"names": ("a", "a")}, {"copies": ("low:5:0", "low:5:0")}):
        with pytest.raises(ValueError, match=r"cost_us|unique"):
            draft_map(DraftConfig(out, tmp_path / "map.json", **wrong))


def test_a_map_without_costs_is_refused_before_training(cartpole: Path, tmp_path: Path) -> None:
    FeatureMap((MappedFeature("all", (0, 1, 2, 3)),)).write(tmp_path / "map.json")
    config = TrainConfig(cartpole, tmp_path / "run", "pole", feature_map=tmp_path / "map.json", bins=(2,))
    with pytest.raises(ValueError, match="no feature has a cost"):
        train(config)
