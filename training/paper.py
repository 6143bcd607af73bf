"""The paper's tables, read from CSV; every figure of them that we show is marked as the paper's.

This module knows nothing about our own results.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from training.results import BASE, Constraint, Setting

__all__ = ["PaperPoint", "PaperTable", "read_paper", "shown_beside"]

_METHODS = {"bdt": "BDT", "rcbc": "RCBC"}
_GROUPS = {"exact": "no_noise_pct", "low": "low_noise_pct", "high": "high_noise_pct"}
# Feature sets of the noisy table: their name in ours, and the cost of everything in them (17 x 20, + 17 x 5, + 17 x 1).
_NOISY = {"N": ("n", 340.0), "N+L": ("nl", 425.0), "N+L+H": ("nlh", 442.0)}


class PaperPoint(NamedTuple):
    """One cell: average cost %, return, and its deviation over the paper's seeds; share of each group acquired, %."""

    cost_pct: float
    value: float
    std: float
    groups: dict[str, float] = {}  # noqa: RUF012  (a tuple's default is shared, and nobody changes it)


_Key = tuple[Setting, str, Constraint]
PaperTable = dict[_Key, PaperPoint]  # by map and dataset, method, constraint
_Row = dict[str, str]


def read_paper(*paths: Path) -> PaperTable:
    """The tables of navigation, of random acquisition and of noisy features, told apart by their columns.

    Raises ValueError naming the file and the line.
    """
    table: PaperTable = {}
    for path in paths:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.DictReader(file)
            points = _reader(rows.fieldnames or ())
            for row in rows:
                try:
                    table.update(points(row))
                except (KeyError, TypeError, ValueError) as error:
                    raise ValueError(f"{path} line {rows.line_num}: {type(error).__name__} {error}") from error
    return table


def shown_beside(table: PaperTable, dataset: str, settings: Iterable[Setting]) -> PaperTable:
    """The table, with its figures of one dataset once more under those of our settings that it has nothing for: for
    traces of players of our own, on the same map."""
    known = {setting for setting, _, _ in table}
    copied: PaperTable = {}
    for ours in set(settings) - known:
        theirs = ours._replace(dataset=dataset)
        copied |= {(ours, *rest): point for (setting, *rest), point in table.items() if setting == theirs}
    return table | copied


def _reader(columns: object) -> Callable[[_Row], Iterator[tuple[_Key, PaperPoint]]]:
    names = set(columns) if isinstance(columns, list) else set()
    if "feature_sets" in names:
        return _noisy
    return _random if "environment" in names else _navigation


def _navigation(row: _Row) -> Iterator[tuple[_Key, PaperPoint]]:
    """A method without a cost in a row has no point there."""
    for key, method in _METHODS.items():
        if row[f"{key}_cost_pct"]:
            numbers = (float(row[f"{key}_{name}"]) for name in ("cost_pct", "return", "std"))
            yield (Setting(row["map"], row["dataset"]), method, _constraint(row)), PaperPoint(*numbers)


def _random(row: _Row) -> Iterator[tuple[_Key, PaperPoint]]:
    numbers = (float(row[name]) for name in ("cost_pct", "normalized_return", "std"))
    yield (Setting(row["environment"], row["dataset"]), "BDT random", _constraint(row)), PaperPoint(*numbers)


def _noisy(row: _Row) -> Iterator[tuple[_Key, PaperPoint]]:
    """Costs are sums there, shares of the full cost here."""
    features, full = _NOISY[row["feature_sets"]]
    groups = {group: float(row[column]) for group, column in _GROUPS.items() if float(row[column] or 0.0) > 0.0}
    constraint = _constraint(row)
    cost = full if constraint == BASE else float(row["cost"])
    constraint = constraint if isinstance(constraint, str) else round(constraint / full, 6)
    std = float(row["return_std"] or 0.0)
    setting = Setting("halfcheetah", "medium-expert", features)
    yield (setting, "BDT", constraint), PaperPoint(100.0 * cost / full, float(row["normalized_return"]), std, groups)


def _constraint(row: _Row) -> Constraint:
    return BASE if row["constraint"] == BASE else float(row["constraint"])
