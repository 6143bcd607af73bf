"""Parquet: which types are read, and that little can stand for much only within limits."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from training.column_map import Column, ColumnMap
from training.parquet_rows import parquet_rows
from training.rows import SourceError

COLUMNS = ColumnMap(episode="match", action=("turn",), reward="score", observation=(Column("rays", 2),))
ARRAYS = {
    "match": pa.array(["a", "a", "b"]),
    "turn": pa.array([1.0, 2.0, 3.0]),
    "score": pa.array([1, 2, 3]),
    "rays": pa.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
}


def cells(tmp_path: Path, arrays: dict[str, pa.Array]) -> list[list[object]]:
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table(arrays), path)
    return [list(row.cells) for batch in parquet_rows(path, COLUMNS) for row in batch.rows]


@pytest.mark.parametrize(
    "arrays",
    [
        {},
        {"turn": pa.array([1, 2, 3], pa.float16())},
        {"turn": pa.array([1, 2, 3], pa.uint8()), "score": pa.array([1, 2, 3], pa.int64())},
        {"match": pa.array(["a", "a", "b"], pa.large_string())},
        {"match": pa.array(["a", "a", "b"]).dictionary_encode(), "turn": ARRAYS["turn"].dictionary_encode()},
        {"rays": pa.array([[1, 2], [3, 4], [5, 6]], pa.list_(pa.int8(), 2))},
        {"rays": pa.array([[1, 2], [3, 4], [5, 6]], pa.large_list(pa.float32()))},
        {"unread": pa.array([{"a": b"1"}] * 3), "unread2": pa.array([b"x"] * 3)},
    ],
)
def test_reads_every_kind_of_text_number_and_list(tmp_path: Path, arrays: dict[str, pa.Array]) -> None:
    assert cells(tmp_path, ARRAYS | arrays) == [["a", [1, 2], 1, 1], ["a", [3, 4], 2, 2], ["b", [5, 6], 3, 3]]


def test_reads_whole_numbers_as_episodes_and_flags_as_numbers(tmp_path: Path) -> None:
    arrays = {"match": pa.array([7, 7, None]).dictionary_encode(), "turn": pa.array([True, None, False])}
    assert cells(tmp_path, ARRAYS | arrays) == [[7, [1, 2], True, 1], [7, [3, 4], None, 2], [None, [5, 6], False, 3]]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"turn": pa.array([b"1", b"2", b"3"])}, "column 'turn' has type binary, expected numbers or flags"),
        ({"turn": pa.array([b"1", b"2", b"3"], pa.binary(1))}, r"type fixed_size_binary\[1\], expected numbers"),
        ({"turn": pa.array([{"x": 1.0}] * 3)}, "column 'turn' has type struct<x: double>, expected numbers"),
        ({"turn": pa.array(["1", "2", "3"])}, "column 'turn' has type string, expected numbers"),
        ({"turn": pa.array([[1.0]] * 3)}, "column 'turn' has type list<element: double>, expected numbers"),
        ({"turn": pa.array([1, 2, 3], pa.decimal128(5, 2))}, r"type decimal128\(5, 2\), expected numbers"),
        ({"turn": pa.array([1, 2, 3], pa.timestamp("us"))}, r"type timestamp\[us\], expected numbers"),
        ({"turn": pa.array([b"x" * 16] * 3, pa.uuid())}, "has type extension<arrow.uuid>, expected numbers"),
        ({"rays": pa.array([1.0, 2.0, 3.0])}, "column 'rays' has type double, expected lists of numbers"),
        ({"rays": pa.array([["1", "2"]] * 3)}, "column 'rays' has type list<element: string>, expected lists of num"),
        ({"rays": pa.array([[[1.0]]] * 3)}, "column 'rays' has type list<element: list.*, expected lists of numbers"),
        ({"match": pa.array([1.0, 2.0, 3.0])}, "column 'match' has type double, expected text or whole numbers"),
        ({"match": pa.array([b"a"] * 3)}, "column 'match' has type binary, expected text or whole numbers"),
        ({"match": pa.array(["a" * 257] * 3)}, "an episode's name has 257 characters, expected at most 256"),
    ],
)
def test_refuses_other_types(tmp_path: Path, arrays: dict[str, pa.Array], message: str) -> None:
    with pytest.raises(SourceError, match=message):
        cells(tmp_path, ARRAYS | arrays)


def test_refuses_a_column_that_is_there_twice(tmp_path: Path) -> None:
    table = pa.table(ARRAYS)
    path = tmp_path / "log.parquet"
    pq.write_table(table.append_column("turn", ARRAYS["turn"]), path)
    with pytest.raises(SourceError, match="column 'turn' is there 2 times, expected once"):
        next(parquet_rows(path, COLUMNS))


def test_refuses_a_list_that_a_few_bytes_stand_for(tmp_path: Path) -> None:
    """Four million equal numbers in one row take no space in the file: they are refused before they are read."""
    rays = pa.ListArray.from_arrays([0, 2, 4, 2**22], pa.repeat(pa.scalar(1.0), 2**22))
    with pytest.raises(SourceError, match="'rays' has 4194304 numbers in the 3 rows of row group 0, expected 2 a row"):
        cells(tmp_path, ARRAYS | {"rays": rays})


@pytest.mark.parametrize("data", [b"PAR1", b"PAR1" + b"\0" * 100 + b"PAR1", b"PAR1\xff\xff\xff\x7fPAR1"])
def test_refuses_a_broken_file(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "log.parquet"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"log\.parquet is not a Parquet file that can be read"):
        next(parquet_rows(path, COLUMNS))


def test_refuses_a_file_whose_pages_are_broken(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    arrays = {name: pa.concat_arrays([array] * 1000) for name, array in ARRAYS.items()}
    pq.write_table(pa.table(arrays), path)
    data = bytearray(path.read_bytes())
    data[4:200] = b"\xff" * 196
    path.write_bytes(data)
    with pytest.raises(SourceError, match="is not a Parquet file that can be read"):
        list(parquet_rows(path, COLUMNS))
