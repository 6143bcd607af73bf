"""Rows of a log, as every reader gives them, and the error that refuses one. This module knows no format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["BATCH_ROWS", "Row", "RowBatch", "SourceError", "missing_column", "shown"]

BATCH_ROWS = 1024  # read at once: enough that a batch costs little beside its rows
_SHOWN = 80  # characters of what stood there
_NAMES = 40  # columns that an error lists


class SourceError(ValueError):
    """A log that cannot be imported: file, line or row, column, what stood there and what was expected."""


class Row(NamedTuple):
    """One timestep."""

    where: str  # file and line, or file and row
    cells: Sequence[object]  # of ColumnMap.names, in their order: bool, int, float, str, list or None


class RowBatch(NamedTuple):
    """Rows that are in memory together, and the share of the source, to 1, that is read once they are."""

    rows: list[Row]
    done: float


def shown(value: object) -> str:
    """What stood there, short enough for a line."""
    text = repr(value)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."


def missing_column(where: str, name: str, there: Sequence[str]) -> SourceError:
    """The error for a column that is not there; it names those that are."""
    names = ", ".join(shown(other) for other in there[:_NAMES])
    more = f" and {len(there) - _NAMES} more" if len(there) > _NAMES else ""
    return SourceError(f"{where}: there is no column {name!r}; there are {names or 'none'}{more}")
