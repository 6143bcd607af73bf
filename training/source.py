"""Which reader a log has: by its suffix, and only if it begins as such a file does. Nothing of it runs or is unpickled.

This module knows nothing about rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from training.column_map import ColumnMap
from training.parquet_rows import parquet_rows
from training.rows import RowBatch, SourceError
from training.text_rows import csv_rows, json_rows

__all__ = ["read_rows"]

_READERS = {".csv": csv_rows, ".jsonl": json_rows, ".parquet": parquet_rows}
_PARQUET = "Parquet"
_BEGINNINGS = {
    b"PAR1": _PARQUET,
    b"PARE": "encrypted Parquet",
    b"\x80": "a pickle",
    b"PK\x03\x04": "a zip archive",  # also .npz, .xlsx and torch's checkpoints
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"\x93NUMPY": "a numpy array",
    b"ARROW1\0\0": "an Arrow file",
    b"SQLite format 3\0": "an SQLite database",
    b"\x1f\x8b": "gzip",
    b"\x28\xb5\x2f\xfd": "zstandard",
    b"\xfd7zXZ\0": "xz",
    b"\xff\xfe": "UTF-16 text",
    b"\xfe\xff": "UTF-16 text",
}


def read_rows(path: Path, columns: ColumnMap) -> Iterator[RowBatch]:
    """The rows of a .csv, .jsonl or .parquet file; only one batch is held. Raises SourceError, at once for a file that
    is none of these, OSError."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise SourceError(f"{path} has suffix {path.suffix!r}, expected one of {', '.join(_READERS)}")
    if not path.is_file():
        raise SourceError(f"{path} is not a file")
    with path.open("rb") as file:
        begins = file.read(max(map(len, _BEGINNINGS)))
    found = next((kind for beginning, kind in _BEGINNINGS.items() if begins.startswith(beginning)), "text or nothing")
    if (found == _PARQUET) != (reader is parquet_rows) or found not in (_PARQUET, "text or nothing"):
        raise SourceError(f"{path} begins like {found}, expected what its suffix says")
    return reader(path, columns)
