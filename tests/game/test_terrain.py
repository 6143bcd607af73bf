import copy
import json
from importlib.resources import files

import pytest

from game.terrain import MapError, load_map, overlaps


def _hard() -> dict:
    return json.loads((files("game") / "maps" / "hard.json").read_text())


def _load(tmp_path, document):
    path = tmp_path / "mine.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return load_map(str(path))


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_shipped_maps_are_at_least_60_m_wide(name):
    terrain = load_map(name)
    assert terrain.name == name
    assert min(terrain.size_m) >= 60


def test_a_map_of_ones_own_loads(tmp_path):
    assert _load(tmp_path, _hard()) == load_map("hard")


def _without(key):
    return lambda document: document.pop(key)


def _with(key, value):
    return lambda document: document.update({key: value})


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (_without("trips"), "trips"),
        (_with("surprise", 1), "surprise"),
        (_with("size_m", [10, 60]), "size_m"),
        (_with("size_m", [61, 60]), "size_m"),
        (_with("walls", [{"rect": [0, 0, 1], "height_m": 3}]), r"walls\[0\]"),
        (_with("walls", [{"rect": [1, 0, 0, 1], "height_m": 3}]), "empty"),
        (_with("walls", [{"rect": [30, 0, 40, 1], "height_m": 3}]), "leaves the map"),
        (_with("ledges", [{"rect": [0, 0, 1, 1], "height_m": 2}]), r"ledges\[0\]"),
        (_with("ledges", [{"rect": [-10, 0, 1, 1], "height_m": 0.6}]), "stands in lava or water"),
        (_with("hazards", [{"kind": "acid", "rect": [0, 0, 1, 1]}]), "acid"),
        (_with("hazards", [{"kind": "lava", "rect": [-36, 0, -20, 10]}]), "start or goal"),
        (_with("pools", [{"zone": [-3, -3, 0, 3], "size_m": 4, "count": 1}]), "too small"),
        (lambda document: document["rivers"][0].update(standing=7), "7 bridges"),
        (lambda document: document["rivers"][0]["slots"].append([-14, 0, -9, 1]), "bank to bank"),
    ],
)
def test_a_bad_map_is_refused_and_the_message_says_where(tmp_path, damage, complaint):
    document = copy.deepcopy(_hard())
    damage(document)
    with pytest.raises(MapError, match=complaint):
        _load(tmp_path, document)


def test_what_is_not_json_or_not_there_is_refused(tmp_path):
    with pytest.raises(MapError, match="not JSON"):
        _load(tmp_path, "{")
    with pytest.raises(MapError, match="no map 'nowhere'"):
        load_map("nowhere")


def test_overlaps_counts_a_margin():
    assert overlaps((0, 0, 2, 2), (1, 1, 3, 3))
    assert not overlaps((0, 0, 2, 2), (2, 0, 3, 2))
    assert overlaps((0, 0, 2, 2), (2.5, 0, 3, 2), 1.0)
