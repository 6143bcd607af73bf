"""The paper's navigation table, read from a CSV; every figure of it that we show is marked as the paper's.

This module knows nothing about our own results.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

from training.results import BASE, Constraint, Setting

__all__ = ["PaperPoint", "PaperTable", "read_paper"]

_METHODS = {"bdt": "BDT", "rcbc": "RCBC"}


class PaperPoint(NamedTuple):
    """One cell: average cost %, return, and its deviation over the paper's seeds."""

    cost_pct: float
    value: float
    std: float


PaperTable = dict[tuple[Setting, str, Constraint], PaperPoint]  # by map and dataset, method, constraint


def read_paper(path: Path) -> PaperTable:
    """Columns: dataset, map, constraint (base or C), then cost_pct, return and std of bdt and rcbc.

    A method without a cost in a row has no point there. Raises ValueError naming the line.
    """
    table: PaperTable = {}
    with path.open(newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        for row in rows:
            try:
                constraint: Constraint = BASE if row["constraint"] == BASE else float(row["constraint"])
                for key, method in _METHODS.items():
                    if row[f"{key}_cost_pct"]:
                        numbers = (float(row[f"{key}_{name}"]) for name in ("cost_pct", "return", "std"))
                        table[Setting(row["map"], row["dataset"]), method, constraint] = PaperPoint(*numbers)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"{path} line {rows.line_num}: {type(error).__name__} {error}") from error
    return table
