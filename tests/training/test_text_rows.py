"""CSV and JSON Lines: what a line may be."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.training.logs import LISTS, column_map
from training.column_map import MAX_COLUMNS, ColumnMap
from training.rows import SourceError
from training.text_rows import MAX_LINE_BYTES, csv_rows, json_rows

COLUMNS = ColumnMap(episode="match", action=("turn",), reward="score", observation=("health",))
HEADER = b"match,turn,score,health,extra\n"


def csv_cells(tmp_path: Path, text: bytes) -> list[list[object]]:
    path = tmp_path / "log.csv"
    path.write_bytes(text)
    return [list(row.cells) for batch in csv_rows(path, COLUMNS) for row in batch.rows]


def json_cells(tmp_path: Path, text: bytes) -> list[list[object]]:
    path = tmp_path / "log.jsonl"
    path.write_bytes(text)
    return [list(row.cells) for batch in json_rows(path, COLUMNS) for row in batch.rows]


def test_csv_cells_become_numbers_and_flags_where_they_are(tmp_path: Path) -> None:
    text = HEADER + b'007, 1e-3 ,TRUE,-2.5,x\r\n"a, ""b""",,nan,1_000,x\n'
    assert csv_cells(tmp_path, text) == [["007", -2.5, 0.001, True], ['a, "b"', "1_000", "", "nan"]]


def test_json_values_stay_what_they_are(tmp_path: Path) -> None:
    text = b'{"match": 7, "turn": "1", "score": null, "health": [1, 2.5], "extra": {"a": 1}}\n'
    assert json_cells(tmp_path, text) == [[7, [1, 2.5], "1", None]]


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_a_byte_order_mark_and_blank_lines_are_passed_over(tmp_path: Path, end: bytes) -> None:
    lines = [b"\xef\xbb\xbf" + HEADER.strip(), b"a,1,2,3,x", b"", b"a,4,5,6,x", b"  ", b""]
    assert csv_cells(tmp_path, end.join(lines)) == [["a", 3.0, 1.0, 2.0], ["a", 6.0, 4.0, 5.0]]
    row = b'{"match": "a", "turn": 1, "score": 2, "health": 3}'
    assert json_cells(tmp_path, b"\xef\xbb\xbf" + end.join([row, b"", row])) == [["a", 3, 1, 2]] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "line 1: there is no column 'match'; there are none"),
        (b"match;turn;score;health\n", "there are 'match;turn;score;health'"),
        (b"match,turn,turn,score,health\n", "line 1: column 'turn' is there 2 times, expected once"),
        (HEADER + b"a,1,2,3,x\na,1,2,3\n", "line 3: 4 cells, expected 5 as in the header"),
        (HEADER + b"a,1,2,3,x,\n", "line 2: 6 cells, expected 5"),
        (HEADER + b'a,1,2,3,"x\ny"\n', "line 2: holds .*, expected one row of CSV in one line"),
        (HEADER + b'a,1,2,3,"x"y\n', "line 2: holds .*, expected one row of CSV in one line"),
        (HEADER + b"a,1,2\r3,x\n", "line 2: holds .*, expected one row of CSV in one line"),
        (HEADER + b"a,1,2,3,\xff\n", "line 2: holds b'.xff.n', expected UTF-8"),
        (HEADER + b"a,1,2,3," + b"x" * MAX_LINE_BYTES, f"line 2 is longer than {MAX_LINE_BYTES} bytes"),
        (HEADER + b"a,1,2,3," + b"x" * 200_000, "line 2: .*field larger than field limit"),
        (b"," * MAX_COLUMNS + b"\n", f"line 1: {MAX_COLUMNS + 1} columns, expected at most {MAX_COLUMNS}"),
    ],
)
def test_csv_refuses(tmp_path: Path, text: bytes, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        csv_cells(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b'{"match": 1}\n', "line 1: there is no column 'health'; there are 'match'"),
        (b"{}\n", "there are none"),
        (b"\n[1, 2]\n", r"line 2: holds '\[1, 2\]', expected a JSON object: Expected `object`, got `array`"),
        (b'{"match": NaN}\n', "line 1: holds '{\"match\": NaN}', expected a JSON object: JSON is malformed: .*no NaN"),
        (b'{"match": 1, "turn": 1e999}\n', "line 1: .* out of range"),
        (b'{"match": 1, "tu', 'line 1: holds \'{"match": 1, "tu\', expected a JSON object: Input data was truncated'),
        (b'{"match":' + b"[" * 100_000 + b"\n", r"line 1: holds '{\"match\":\[{70}'*\.\.\., expected a JSON object"),
        (b'{"match": "\xff"}\n', "line 1: holds b'.xff\"}.n', expected UTF-8"),
        (b'{"match": "' + b"x" * MAX_LINE_BYTES, f"line 1 is longer than {MAX_LINE_BYTES} bytes"),
    ],
)
def test_json_lines_refuse(tmp_path: Path, text: bytes, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        json_cells(tmp_path, text)


def test_csv_has_no_lists(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(HEADER)
    columns = column_map(observation=None, **LISTS, timestep=None, terminated=None, truncated=None)
    with pytest.raises(SourceError, match="'rays' has a size, but a CSV cell holds one number"):
        next(csv_rows(path, columns))


@pytest.mark.parametrize("read", [csv_rows, json_rows])
def test_an_endless_line_is_not_read_to_its_end(tmp_path: Path, read: Callable) -> None:
    """A line without an end is refused after the longest there may be, whatever the file's size."""
    path = tmp_path / "log"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: no disk, but a terabyte to whoever reads it
    with pytest.raises(SourceError, match="line 1 is longer than"):
        list(read(path, COLUMNS))


def test_the_limit_of_a_cell_is_that_of_the_csv_module() -> None:
    assert csv.field_size_limit() == 131_072


def test_long_lines_make_short_batches(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(HEADER + (b"a,1,2,3," + b"x" * 100_000 + b"\n") * 100)
    sizes = [len(batch.rows) for batch in csv_rows(path, COLUMNS)]
    assert sum(sizes) == 100
    assert max(sizes) == 42, "4 MiB of text"
