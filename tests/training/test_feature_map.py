"""What a feature map makes of observations, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.feature_map import FeatureMap, MappedFeature, parts_of

FLAT = FeatureMap(
    (
        MappedFeature("height", (2,)),
        MappedFeature("speed", (4, 0), cost_us=3.0),
        MappedFeature("angle", (1,)),
        MappedFeature("rough_speed", (4, 0), cost_us=1.0, noise=0.5, group="rough"),
    )
)
KEYED = FeatureMap((MappedFeature("grid", key="camera", cost_us=9.0), MappedFeature("x", (0,), key="body")))


@given(st.integers(1, 6), st.integers(0, 2**31))
def test_features_are_the_numbers_that_they_name(length: int, seed: int) -> None:
    observations = np.random.default_rng(seed).normal(size=(length + 1, 5))
    free, costly = FLAT.split(parts_of(observations, length), np.random.default_rng(seed))
    assert (free.dtype, costly.dtype) == (np.float32, np.float32)
    np.testing.assert_array_equal(free, observations[:length, [2, 1]].astype(np.float32))
    np.testing.assert_array_equal(costly[:, :2], observations[:length, [4, 0]].astype(np.float32))


def test_the_table_has_the_features_in_order() -> None:
    table = FLAT.table({"": 5})
    assert [(feature.name, feature.size) for feature in table.free] == [("height", 1), ("angle", 1)]
    assert [(feature.name, feature.size) for feature in table.costly] == [("speed", 2), ("rough_speed", 2)]
    assert table.costs_us.tolist() == [3.0, 1.0]
    assert FLAT.groups == ("", "rough")


def test_noise_is_added_to_its_copy_alone_and_follows_the_seed() -> None:
    observations = np.zeros((4000, 5))
    _, costly = FLAT.split(parts_of(observations, 4000), np.random.default_rng(1))
    assert not costly[:, :2].any()
    assert costly[:, 2:].std(axis=0) == pytest.approx([0.5, 0.5], rel=0.05)
    _, again = FLAT.split(parts_of(observations, 4000), np.random.default_rng(1))
    np.testing.assert_array_equal(costly, again)
    _, other = FLAT.split(parts_of(observations, 4000), np.random.default_rng(2))
    assert not np.array_equal(costly, other)


def test_parts_of_a_dict_are_flattened() -> None:
    observations = {"camera": np.arange(24.0).reshape(3, 2, 4), "body": np.array([[5.0], [6.0], [7.0]])}
    free, costly = KEYED.split(parts_of(observations, 2), np.random.default_rng(0))
    assert free.tolist() == [[5.0], [6.0]]
    assert costly.tolist() == [list(range(8)), list(range(8, 16))]
    assert KEYED.table({"camera": 8, "body": 1}).n_costly == 8


def test_no_free_numbers_are_an_empty_column() -> None:
    free, costly = FeatureMap((MappedFeature("all", cost_us=1.0),)).split(
        parts_of(np.ones((3, 2)), 3), np.random.default_rng(0)
    )
    assert (free.shape, costly.shape) == ((3, 0), (3, 2))


@pytest.mark.parametrize(
    ("feature_map", "sizes", "message"),
    [
        (FLAT, {"": 4}, "feature speed has number 4, the observation has 0 to 3"),
        (FLAT, {"body": 5}, r"feature height has key '', expected one of \['body'\]"),
        (KEYED, {"": 5}, "feature grid has key 'camera', expected none: the observation is flat"),
    ],
)
def test_refuses_what_the_observation_does_not_have(
    feature_map: FeatureMap, sizes: dict[str, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        feature_map.table(sizes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"features": [{"name": "a", "numbers": []}]}', "expected indices from 0"),
        ('{"features": [{"name": "a", "numbers": [-1]}]}', "expected indices from 0"),
        ('{"features": [{"name": "a", "noise": -1}]}', "expected a finite standard deviation"),
        ('{"features": [{"name": "a", "nubmers": [1]}]}', "unknown field `nubmers`"),
        ("{", "truncated"),
    ],
)
def test_refuses_a_bad_file_by_name(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "map.json").write_text(text)
    with pytest.raises(ValueError, match=rf"map\.json: .*{message}"):
        FeatureMap.read(tmp_path / "map.json")


def test_what_is_written_is_read(tmp_path: Path) -> None:
    for feature_map in (FLAT, KEYED):
        feature_map.write(tmp_path / "map.json")
        assert FeatureMap.read(tmp_path / "map.json") == feature_map


def test_shipped_maps_fit_their_environments() -> None:
    """Checked against the sizes that gymnasium documents, so that no simulator is needed."""
    folder = Path(__file__).parents[2] / "training" / "feature_maps"
    sizes = {"halfcheetah": 17, "hopper": 11, "walker2d": 17}
    copies = {"halfcheetah-nl": 2, "halfcheetah-nl-faint": 2, "halfcheetah-nlh": 3, "halfcheetah-nlh-faint": 3}
    for file in sorted(folder.glob("*.json")):
        size = sizes[file.stem.partition("-")[0]]
        table = FeatureMap.read(file).table({"": size})
        assert table.n_queries == size * copies.get(file.stem, 1)
        assert table.n_free == 0
    assert FeatureMap.read(folder / "halfcheetah-nlh.json").table({"": 17}).costs_us.sum() == 442.0
