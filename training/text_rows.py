"""Rows of CSV and JSON Lines, a batch at a time. A row is one line. This module knows nothing about episodes."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec

from training.column_map import MAX_COLUMNS, ColumnMap
from training.rows import BATCH_ROWS, Row, RowBatch, SourceError, missing_column, shown

__all__ = ["MAX_LINE_BYTES", "csv_rows", "json_rows"]

MAX_LINE_BYTES = 2**20  # MAX_NUMBERS numbers of 25 characters take 0.4 MiB
_BATCH_BYTES = 2**22  # of text in a batch: as Python's numbers, it takes up to ten times that
_BOM = b"\xef\xbb\xbf"
_FLAGS = {"true": True, "false": False}
_JSON = msgspec.json.Decoder(dict[str, object])

Lines = Iterator[tuple[str, str]]  # where a line stands, and its text


def csv_rows(path: Path, columns: ColumnMap) -> Iterator[RowBatch]:
    """Read CSV with a header: commas, double quotes, UTF-8. Numbers and true/false become such in every column but the
    episode's; anything else stays text. Raises SourceError."""
    lists = [column.column for column in columns.numbers if column.size is not None]
    if lists:
        raise SourceError(f"{path}: column {lists[0]!r} has a size, but a CSV cell holds one number; name each column")
    with path.open("rb") as file:
        lines = _lines(path, file)
        where, text = next(lines, (f"{path}: line 1", ""))
        header = _split(where, text)
        if len(header) > MAX_COLUMNS:
            raise SourceError(f"{where}: {len(header)} columns, expected at most {MAX_COLUMNS}")
        wanted = [(place, name == columns.episode) for name, place in _places(where, header, columns)]

        def parse(where: str, text: str) -> list[object]:
            cells = _split(where, text)
            if len(cells) != len(header):
                raise SourceError(f"{where}: {len(cells)} cells, expected {len(header)} as in the header")
            return [cells[i] if is_text else _value(cells[i]) for i, is_text in wanted]

        yield from _batches(path, file, lines, parse)


def _places(where: str, header: list[str], columns: ColumnMap) -> Iterator[tuple[str, int]]:
    places = {name: i for i, name in enumerate(header)}
    counts = Counter(header)
    for name in columns.names:
        if name not in places:
            raise missing_column(where, name, header)
        if counts[name] > 1:
            raise SourceError(f"{where}: column {name!r} is there {counts[name]} times, expected once")
        yield name, places[name]


def json_rows(path: Path, columns: ColumnMap) -> Iterator[RowBatch]:
    """Read JSON Lines: one object a line, UTF-8. Raises SourceError."""
    names = columns.names

    def parse(where: str, text: str) -> list[object]:
        try:
            row = _JSON.decode(text)
        except (msgspec.DecodeError, RecursionError) as error:
            hint = " (JSON knows no NaN and no Infinity)" if "NaN" in text or "Infinity" in text else ""
            wrong = f"{where}: holds {shown(text.strip())}, expected a JSON object: {error}{hint}"
            raise SourceError(wrong) from error
        try:
            return [row[name] for name in names]
        except KeyError as error:
            raise missing_column(where, error.args[0], list(row)) from error

    with path.open("rb") as file:
        yield from _batches(path, file, _lines(path, file), parse)


def _batches(path: Path, file: BinaryIO, lines: Lines, parse: Callable[[str, str], list[object]]) -> Iterator[RowBatch]:
    size = max(path.stat().st_size, 1)
    rows: list[Row] = []
    held = 0
    for where, text in lines:
        rows.append(Row(where, parse(where, text)))
        held += len(text)
        if len(rows) == BATCH_ROWS or held >= _BATCH_BYTES:
            yield RowBatch(rows, file.tell() / size)
            rows, held = [], 0
    yield RowBatch(rows, 1.0)


def _lines(path: Path, file: BinaryIO) -> Lines:
    """Lines that are not blank; never more of the file than the longest line that may be."""
    number = 0
    while line := file.readline(MAX_LINE_BYTES + 1):
        number += 1
        where = f"{path}: line {number}"
        if len(line) > MAX_LINE_BYTES:
            raise SourceError(f"{where} is longer than {MAX_LINE_BYTES} bytes")
        try:
            text = (line.removeprefix(_BOM) if number == 1 else line).decode()
        except UnicodeDecodeError as error:
            raise SourceError(f"{where}: holds {shown(line[error.start : error.start + 8])}, expected UTF-8") from error
        if not text.isspace():
            yield where, text


def _split(where: str, text: str) -> list[str]:
    """Cells of one line. The csv module has its own limit of a cell, 131,072 characters."""
    try:
        return next(csv.reader([text], strict=True))
    except csv.Error as error:
        raise SourceError(
            f"{where}: holds {shown(text.strip())}, expected one row of CSV in one line: {error}"
        ) from error


def _value(text: str) -> object:
    """A number or a flag where the text says one. Python's float also reads 1_000, and words for what is not finite."""
    try:
        number = float(text)
    except ValueError:
        return _FLAGS.get(text.strip().lower(), text)
    return number if math.isfinite(number) and "_" not in text else text
