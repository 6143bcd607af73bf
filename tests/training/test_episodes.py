"""Rows into episodes: where they begin and end, and which rows are refused."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.training.logs import LISTS, WRITERS, column_map, rows
from training import episodes
from training.column_map import ColumnMap
from training.episodes import Episode, cut
from training.rows import Row, RowBatch, SourceError
from training.source import read_rows


def read(log: list[dict[str, object]], columns: ColumnMap) -> list[Episode]:
    return list(cut([Row(f"row {i}", [row[name] for name in columns.names]) for i, row in enumerate(log)], columns))


def changed(log: list[dict[str, object]], row: int, **cells: object) -> list[dict[str, object]]:
    log[row] |= cells
    return log


def test_numbers_stand_where_the_map_says() -> None:
    first, second = read(rows(2, 3), column_map())
    np.testing.assert_array_equal(second.observations[""], [[98, 0.25], [97, 0.375], [96, 0.5], [96, 0.5]])
    np.testing.assert_array_equal(second.actions, [[1, 0], [-1, 1], [1, 0]])
    np.testing.assert_array_equal(first.rewards, [0, 0.25])
    assert {array.dtype for array in (first.observations[""], first.actions, first.rewards)} == {np.dtype("float32")}


def test_parts_and_lists() -> None:
    columns = column_map(observation=None, timestep=None, terminated=None, truncated=None, **LISTS)
    (episode,) = read(rows(2), columns)
    np.testing.assert_array_equal(episode.observations["body"], [[100], [99], [99]])
    np.testing.assert_array_equal(
        episode.observations["rays"], [[0.5, 2, 3, 0], [1.5, 2, 3, 0.125], [1.5, 2, 3, 0.125]]
    )
    np.testing.assert_array_equal(episode.actions, [[0, -1], [0.0625, -1]])


CHOICE = {"action": [{"column": "key", "choices": 3}]}


def test_a_choice_is_a_whole_number_a_timestep() -> None:
    log = [row | {"key": key} for row, key in zip(rows(4), (2, 0.0, True, 1), strict=True)]
    (episode,) = read(log, column_map(**CHOICE))
    assert episode.actions.tolist() == [2, 0, 1, 1]
    assert episode.actions.dtype == np.int64


@pytest.mark.parametrize("key", [3, -1, 0.5, None, "1", float("nan")])
def test_refuses_what_is_no_choice(key: object) -> None:
    log = [row | {"key": 0} for row in rows(3)]
    with pytest.raises(SourceError, match=r"^row 1: column 'key' .*expected a whole number from 0 to 2, as the column"):
        read(changed(log, 1, key=key), column_map(**CHOICE))


@pytest.mark.parametrize(
    ("flags", "fields", "ends"),
    [
        ({"died": True, "stopped": False}, {}, (True, False)),
        ({"died": False, "stopped": True}, {}, (False, True)),
        ({"died": 1, "stopped": 1.0}, {}, (True, True)),
        ({"died": False, "stopped": 0}, {}, (False, True)),
        ({"died": False, "stopped": False}, {"truncated": None}, (False, True)),
        ({"died": True, "stopped": False}, {"truncated": None}, (True, False)),
        ({"died": True, "stopped": False}, {"terminated": None, "truncated": None}, (False, True)),
    ],
)
def test_how_an_episode_ends(flags: dict[str, object], fields: dict[str, None], ends: tuple[bool, bool]) -> None:
    (episode,) = read(changed(rows(3), 2, **flags), column_map(**fields))
    assert (episode.terminated, episode.truncated) == ends


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ({"health": None}, "column 'health' is empty, expected a finite number"),
        ({"health": ""}, "column 'health' is empty"),
        ({"health": "12"}, "column 'health' holds '12', expected a finite number"),
        ({"health": "x" * 200}, "column 'health' holds 'x{79}\\.\\.\\., expected"),
        ({"health": float("nan")}, "column 'health' holds nan, expected a finite number that float32 holds"),
        ({"speed": float("-inf")}, "column 'speed' holds -inf, expected a finite"),
        ({"score": 3.5e38}, "column 'score' holds 3.5e[+]38, expected a finite"),
        ({"score": 10**400}, "column 'score' holds 10{79}\\.\\.\\., expected a finite"),
        ({"speed": [1.0]}, r"column 'speed' holds \[1.0\], expected a finite number"),
        ({"speed": {"x": 1}}, "column 'speed' holds {'x': 1}, expected a finite number"),
        ({"turn": 1.5}, "column 'turn' holds 1.5, expected a number from -1 to 1, as the column map says"),
        ({"turn": None}, "column 'turn' is empty, expected a number from -1 to 1"),
        ({"died": "false"}, "column 'died' holds 'false', expected true, false, 1 or 0"),
        ({"died": None}, "column 'died' is empty, expected true"),
        ({"stopped": 2}, "column 'stopped' holds 2, expected true"),
        ({"tick": 15}, "column 'tick' holds 15, expected 14: it rises by 1 in an episode"),
        ({"tick": 13}, "column 'tick' holds 13, expected 14"),
        ({"tick": 14.5}, "column 'tick' holds 14.5, expected a whole number"),
        ({"tick": float("inf")}, "column 'tick' holds inf, expected a whole number"),
        ({"tick": float("nan")}, "column 'tick' holds nan, expected a whole number"),
        ({"tick": 10**400}, "column 'tick' holds 10{79}"),
        ({"tick": True}, "column 'tick' holds True, expected a whole number"),
        ({"match": None}, "column 'match' is empty, expected text of 1 to 256 characters or a whole number"),
        ({"match": 1.0}, "column 'match' holds 1.0, expected text"),
        ({"match": "m" * 257}, "column 'match' holds 'm{79}\\.\\.\\., expected text of 1 to 256"),
        ({"match": "m0"}, "episode 'm0' comes back, expected its rows to stand together"),
    ],
)
def test_refuses_a_row(cells: dict[str, object], message: str) -> None:
    """Row 6 is the fifth of the second episode."""
    with pytest.raises(SourceError, match=f"^row 6: {message}"):
        read(changed(rows(2, 8), 6, **cells), column_map())


@pytest.mark.parametrize(
    ("rays", "message"),
    [
        ([1.0, 2.0], r"column 'rays' holds \[1.0, 2.0\], expected a list of 3 numbers"),
        (1.0, "column 'rays' holds 1.0, expected a list of 3 numbers"),
        ("abc", "column 'rays' holds 'abc', expected a list of 3 numbers"),
        (None, "column 'rays' is empty, expected a list of 3 numbers"),
        ([1.0, None, 2.0], r"column 'rays\[1\]' is empty, expected a finite number"),
        ([1.0, 2.0, "3"], r"column 'rays\[2\]' holds '3', expected a finite number"),
        ([[1.0], 2.0, 3.0], r"column 'rays\[0\]' holds \[1.0\], expected a finite number"),
    ],
)
def test_refuses_a_list(rays: object, message: str) -> None:
    columns = column_map(observation=None, timestep=None, terminated=None, truncated=None, **LISTS)
    with pytest.raises(SourceError, match=f"^row 1: {message}"):
        read(changed(rows(3), 1, rays=rays), columns)


@pytest.mark.parametrize("flag", ["died", "stopped"])
def test_refuses_an_end_before_the_last_row(flag: str) -> None:
    """The row that is named is the one whose flag is wrong, not the one that shows it."""
    with pytest.raises(SourceError, match=f"^row 1: column '{flag}' holds True, expected false before the last row"):
        read(changed(rows(4), 1, **{flag: True}), column_map())


def test_a_number_and_the_same_text_are_one_episode() -> None:
    log = changed(changed(changed(rows(3), 0, match=7), 1, match="7"), 2, match=7)
    assert len(read(log, column_map())) == 1


def test_the_longest_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "MAX_EPISODE_NUMBERS", 24)  # of 5 a row: 4 rows
    assert len(read(rows(4, 4), column_map())) == 2
    with pytest.raises(SourceError, match="row 8: episode 'm1' is longer than 4 rows"):
        read(rows(4, 5), column_map())


def test_the_most_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "MAX_EPISODES", 2)
    assert len(read(rows(1, 1), column_map())) == 2
    with pytest.raises(SourceError, match="row 2: episode 'm2' is one more than 2"):
        read(rows(1, 1, 1), column_map())


@pytest.mark.parametrize("suffix", WRITERS)
def test_no_more_is_read_than_the_episode_and_the_batch_it_ends_in(tmp_path: Path, suffix: str) -> None:
    """12 episodes of 700 rows in batches of 1024: whoever has n episodes has asked for no row beyond the batch that
    holds the first row of the next one."""
    path = WRITERS[suffix](tmp_path / f"log{suffix}", rows(*[700] * 12))
    asked = 0

    def counted(batches: Iterator[RowBatch]) -> Iterator[RowBatch]:
        nonlocal asked
        for batch in batches:
            asked += 1
            yield batch

    batches = counted(read_rows(path, column_map()))
    read_episodes = cut(chain.from_iterable(batch.rows for batch in batches), column_map())
    after: list[Any] = [asked for episode in read_episodes if len(episode.rewards) == 700]
    assert after == [*(700 * n // 1024 + 1 for n in range(1, 12)), asked]
