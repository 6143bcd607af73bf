"""Which kinds of features are acquired at which cost, in Markdown: the paper's table of noisy features, with ours.

This module knows nothing about files or figures.
"""

from __future__ import annotations

from collections.abc import Sequence

from training.paper import PaperTable
from training.results import BASE, Constraint, Measurement, Series, Setting
from training.spend import by_constraint, statistic
from training.tables import constraint_name, markdown, number

__all__ = ["group_table"]


def group_table(measurements: Sequence[Measurement], setting: Setting, paper: PaperTable) -> str:
    """Rows: series and C; columns: cost, R, and the share of each group's features. Empty where nothing has groups."""
    counted = [one for one in measurements if one.kind == "soft" and one.numbers.acquired_pct]
    names = list(dict.fromkeys(name for one in counted for name in one.numbers.acquired_pct))
    if not counted:
        return ""
    rows = [["", "C", "cost", "R", *names]]
    for series in sorted({one.run.series for one in counted}):
        for constraint, cell in by_constraint(one for one in counted if one.run.series == series).items():
            rows.append([str(series), constraint_name(constraint), *_ours(cell, names)])
            rows += _theirs(paper, setting, series, constraint, names)
    return markdown(rows)


def _ours(cell: Sequence[Measurement], names: Sequence[str]) -> list[str]:
    cost = statistic([one.numbers.soft_cost_pct for one in cell]).mean
    shares = [statistic([one.numbers.acquired_pct[name] for one in cell]).mean for name in names]
    return [f"{cost:.1f} %", number(statistic([one.value for one in cell])), *(f"{share:.1f} %" for share in shares)]


def _theirs(
    paper: PaperTable, setting: Setting, series: Series, constraint: Constraint, names: Sequence[str]
) -> list[list[str]]:
    """The paper has fixed budgets only; they stand beside one network for every budget as well."""
    point = paper.get((setting, series.method.removesuffix(" conditioned"), constraint))
    if point is None:
        return []
    shares = [f"*{point.groups[name]:.1f} %*" if name in point.groups else "–" for name in names]
    name = constraint_name(constraint)
    cost = f"*{point.cost_pct:.1f} %*"
    return [
        [
            "*paper*",
            f"*{name if constraint != BASE else 'base'}*",
            cost,
            f"*{point.value:.1f} ± {point.std:.1f}*",
            *shares,
        ]
    ]
