"""Column maps: what they stand for, and which ones are refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.training.logs import COLUMNS, LISTS, column_map
from training.column_map import MAX_NUMBERS, ColumnMap


def test_the_order_of_numbers_is_observation_action_reward() -> None:
    assert column_map().labels == ("health", "speed", "turn", "fire", "score")
    assert column_map().names == ("match", "tick", "died", "stopped", "health", "speed", "turn", "fire", "score")


def test_lists_and_parts(tmp_path: Path) -> None:
    path = tmp_path / "columns.json"
    path.write_text(json.dumps(LISTS))
    columns = ColumnMap.read(path)
    assert columns.labels == ("health", "rays[0]", "rays[1]", "rays[2]", "speed", "stick[0]", "stick[1]", "score")
    assert {key: sum(column.width for column in part) for key, part in columns.observed.items()} == {
        "body": 1,
        "rays": 4,
    }


def test_a_column_that_stands_in_two_places_is_read_once() -> None:
    columns = column_map(observation=["health", "turn"], reward="health")
    assert columns.names.count("health") == columns.names.count("turn") == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"observations": {"a": ["health"]}}, "either `observation` or `observations`"),
        ({"observation": None}, "either `observation` or `observations`"),
        ({"observation": None, "observations": {"a": []}}, r"observations\.a is an empty list"),
        ({"observation": None, "observations": {"a/b": ["health"]}}, "key 'a/b', expected a match"),
        ({"observation": ["health", "speed", "health"]}, "observation names column 'health' 2 times"),
        ({"action": []}, "action is an empty list"),
        ({"action": [{"column": "turn", "low": 1, "high": 1}]}, r"range \[1.0, 1.0\], expected increasing"),
        ({"action": [{"column": "turn", "low": -1e39}]}, "low -1e[+]39, expected a finite float32"),
        ({"action": [{"column": "turn", "hgih": 1}]}, "unknown field `hgih` - at `\\$.action\\[0\\]`"),
        ({"action": [{"column": "fire", "choices": 1}]}, "'fire' has 1 choices, expected 2 to"),
        ({"action": [{"column": "fire", "choices": 2, "high": 1}]}, "'fire' has choices, expected neither size nor"),
        ({"action": [{"column": "fire", "choices": 2, "size": 2}]}, "'fire' has choices, expected neither size nor"),
        ({"action": ["turn", {"column": "fire", "choices": 2}]}, "choices in one of several columns, expected"),
        ({"observation": [{"column": "rays", "low": 0}]}, "unknown field `low`"),
        ({"observation": [{"column": "rays", "size": 0}]}, "size 0, expected 1 to"),
        ({"observation": [{"column": "rays", "size": MAX_NUMBERS}]}, f"expected at most .* and {MAX_NUMBERS}"),
        ({"observation": [{"column": "turn", "size": 2}]}, "'turn' has size None and 2"),
        ({"observation": ["health", ""]}, "column is a name of 0 characters"),
        ({"reward": "s" * 257}, "reward is a name of 257 characters"),
        ({"reward": None}, "missing required field `reward`"),
        ({"rewards": "score"}, "unknown field `rewards`"),
        ({"episode": 3}, "Expected `str`, got `int` - at `\\$.episode`"),
        ({"environment": "no such id!"}, "environment is 'no such id!', expected a gymnasium id"),
    ],
)
def test_refuses(tmp_path: Path, fields: dict[str, object], message: str) -> None:
    path = tmp_path / "columns.json"
    path.write_text(json.dumps({name: value for name, value in {**COLUMNS, **fields}.items() if value is not None}))
    with pytest.raises(ValueError, match=rf"columns\.json: .*{message}"):
        ColumnMap.read(path)


@pytest.mark.parametrize("text", ["", "[1]", "[" * 100_000, '{"episode": "a"'])
def test_refuses_what_is_no_map(tmp_path: Path, text: str) -> None:
    path = tmp_path / "columns.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"columns\.json: "):
        ColumnMap.read(path)


def test_refuses_a_file_that_is_too_long(tmp_path: Path) -> None:
    path = tmp_path / "columns.json"
    path.write_text(json.dumps(COLUMNS) + " " * 2**22)
    with pytest.raises(ValueError, match="longer than 4194304 bytes"):
        ColumnMap.read(path)
