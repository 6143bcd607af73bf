"""Rows of Parquet, a batch at a time. Only columns that are asked for are read, and only text, numbers, flags and
lists of numbers are: no struct, no bytes, no extension type. This module knows nothing about episodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from training.column_map import MAX_COLUMNS, MAX_NAME, ColumnMap
from training.rows import BATCH_ROWS, Row, RowBatch, SourceError, missing_column

__all__ = ["parquet_rows"]

_BATCH_NUMBERS = 2**20  # in a batch: as Python's numbers, 32 MiB
_BUFFER_BYTES = 2**18  # of a column chunk, in place of the whole of it
_FOOTER_BYTES = 2**26  # and entries of a list in it: the footer of 16,384 columns takes 2 MB a row group
_SPARE = 2**20  # numbers in lists that are too long, which a row group may hold and a row's own error tells


def parquet_rows(path: Path, columns: ColumnMap) -> Iterator[RowBatch]:
    """Read a Parquet file. Rows are counted from 0. Raises SourceError."""
    names = list(columns.names)
    n_rows = max(1, min(BATCH_ROWS, _BATCH_NUMBERS // len(columns.labels)))
    begin = 0
    try:
        with pq.ParquetFile(
            path,
            read_dictionary=[columns.episode],  # a long text that stands in every row is in memory once
            buffer_size=_BUFFER_BYTES,
            pre_buffer=False,
            thrift_string_size_limit=_FOOTER_BYTES,
            thrift_container_size_limit=_FOOTER_BYTES,
        ) as file:
            _check_types(path, file.schema_arrow, columns)
            _check_lists(path, file.metadata, columns)
            total = max(file.metadata.num_rows, 1)
            for batch in file.iter_batches(n_rows, columns=names, use_threads=False):
                _check_episodes(path, batch.column(columns.episode))
                cells = zip(*(batch.column(name).to_pylist() for name in names), strict=True)
                rows = [Row(f"{path}: row {begin + i} (counted from 0)", row) for i, row in enumerate(cells)]
                begin += len(rows)
                yield RowBatch(rows, begin / total)
    except (pa.ArrowException, OSError) as error:
        raise SourceError(f"{path} is not a Parquet file that can be read: {error}") from error


def _check_types(path: Path, schema: pa.Schema, columns: ColumnMap) -> None:
    if len(schema.names) > MAX_COLUMNS:
        raise SourceError(f"{path}: {len(schema.names)} columns, expected at most {MAX_COLUMNS}")
    lists = {column.column: column.size is not None for column in columns.numbers}
    for name in columns.names:
        there = schema.get_all_field_indices(name)
        if not there:
            raise missing_column(str(path), name, schema.names)
        if len(there) > 1:
            raise SourceError(f"{path}: column {name!r} is there {len(there)} times, expected once")
        expected: tuple[Callable[[pa.DataType], bool], str] = (_is_number, "numbers or flags")
        if name == columns.episode:
            expected = (_is_episode, "text or whole numbers")
        elif lists.get(name):
            expected = (_is_list, "lists of numbers")
        kind = _plain(schema.field(there[0]).type)
        if not expected[0](kind):
            raise SourceError(f"{path}: column {name!r} has type {str(kind)[:80]}, expected {expected[1]}")


def _check_lists(path: Path, metadata: pq.FileMetaData, columns: ColumnMap) -> None:
    """A few bytes can stand for a list of any length: what is in the footer is looked at before anything is read."""
    sizes = {column.column: column.size for column in columns.numbers if column.size is not None}
    for group in range(metadata.num_row_groups if sizes else 0):
        row_group = metadata.row_group(group)
        for index in range(row_group.num_columns):
            chunk = row_group.column(index)
            parts = chunk.path_in_schema.rsplit(".", 2)  # name.list.element; old writers have name.array
            name = parts[0] if parts[0] in sizes else ".".join(parts[:-1])
            if name in sizes and chunk.num_values > row_group.num_rows * sizes[name] + _SPARE:
                raise SourceError(
                    f"{path}: column {name!r} has {chunk.num_values} numbers in the {row_group.num_rows} rows of row "
                    f"group {group}, expected {sizes[name]} a row"
                )


def _check_episodes(path: Path, names: pa.Array) -> None:
    if pa.types.is_dictionary(names.type) and _is_text(names.type.value_type):
        longest = pc.max(pc.utf8_length(names.dictionary)).as_py() or 0
        if longest > MAX_NAME:
            raise SourceError(f"{path}: an episode's name has {longest} characters, expected at most {MAX_NAME}")


def _plain(kind: pa.DataType) -> pa.DataType:
    """Categories are what they stand for."""
    return kind.value_type if pa.types.is_dictionary(kind) else kind


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _is_list(kind: pa.DataType) -> bool:
    lists = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(is_list(kind) for is_list in lists) and _is_number(kind.value_type)


def _is_text(kind: pa.DataType) -> bool:
    return pa.types.is_string(kind) or pa.types.is_large_string(kind)


def _is_episode(kind: pa.DataType) -> bool:
    return _is_text(kind) or pa.types.is_integer(kind)
