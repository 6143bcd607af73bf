"""Tables of a report in Markdown: the paper's tables with our cells beside theirs, and returns at equal spend.

A cell that was not measured says so; nothing is filled in. This module knows nothing about files or figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from training.paper import PaperTable
from training.results import BASE, NO_RAYS, Constraint, Kind, Measurement, Series, Setting
from training.spend import Statistic, at_spend, return_at, statistic

__all__ = ["METHODS", "columns", "constraint_name", "cost_table", "markdown", "number", "spend_table"]

METHODS = ("BDT", "RCBC", "BC", "IQL", "BDT random", "BDT conditioned")
_NOT_MEASURED = "not measured"
_DASH = "–"


def cost_table(measurements: Sequence[Measurement], setting: Setting, paper: PaperTable) -> str:
    """One map and dataset in the paper's layout: its rows, and those that were measured."""
    series = columns(measurements)
    rows = [["C", *(str(one) for one in series)]]
    for constraint in _constraints(measurements, setting, paper):
        cells = [_cell(_measured(measurements, one, constraint), constraint) for one in series]
        rows.append([constraint_name(constraint), *cells])
        theirs = [_paper_cell(paper, setting, one, constraint) for one in series]
        if any(cell != _DASH for cell in theirs):
            rows.append([f"*paper, {constraint_name(constraint)}*", *theirs])
    return markdown(rows)


def spend_table(
    measurements: Sequence[Measurement], setting: Setting, kind: Kind, spends_pct: Sequence[float], paper: PaperTable
) -> str:
    """Return of each series at equal spend; a dash outside of what its own curves reach. Rows: series, and the paper's.

    Where a budget is hard, the paper has nothing to compare.
    """
    rows = [["spend", *(f"{spend:g} %" for spend in spends_pct)]]
    for one in columns(measurements):
        ours = [each for each in measurements if each.run.series == one and each.kind == kind]
        rows.append([str(one), *(_with_seeds(at_spend(spend, ours)) for spend in spends_pct)])
    for method in sorted({method for where, method, _ in paper if where == setting}) if kind == "soft" else []:
        points = [
            (point.cost_pct, point.value)
            for (where, name, constraint), point in paper.items()
            if (where, name) == (setting, method) and constraint != BASE
        ]
        values = [return_at(spend, points) for spend in spends_pct]
        cells = [_DASH if value is None else f"*{value:.1f}*" for value in values]
        rows.append([f"*{method}, paper's means*", *cells])
    return markdown(rows)


def columns(measurements: Iterable[Measurement]) -> list[Series]:
    """The paper's methods and ours, measured or not, then whatever else was measured."""
    measurements = list(measurements)
    learned = {one.run.series for one in measurements if one.constraint not in (BASE, NO_RAYS)}
    names = {one.run.series.method for one in measurements}
    series: list[Series] = []
    for method in (*METHODS, *sorted(names - set(METHODS))):
        series += sorted(one for one in learned if one.method == method) or [Series(method)]
    return series


def constraint_name(constraint: Constraint) -> str:
    """As the paper's rows are called."""
    if constraint == NO_RAYS:
        return "no costly features"
    return constraint if isinstance(constraint, str) else f"{100.0 * constraint:g} %"


def number(stat: Statistic, decimals: int = 1) -> str:
    """Mean ± deviation; one seed has none, and says so."""
    if stat.std is None:
        return f"{stat.mean:.{decimals}f} (n=1)"
    return f"{stat.mean:.{decimals}f} ± {stat.std:.{decimals}f} (n={stat.n})"


def _constraints(measurements: Sequence[Measurement], setting: Setting, paper: PaperTable) -> list[Constraint]:
    measured = {one.constraint for one in measurements}
    theirs = {constraint for where, _, constraint in paper if where == setting}
    shares = {one for one in {*measured, *theirs} if not isinstance(one, str)}
    last: list[Constraint] = [NO_RAYS] if NO_RAYS in measured else []
    return [BASE, *sorted(shares - {1.0}, reverse=True), *last]  # C = 1 is the base


def _measured(measurements: Iterable[Measurement], series: Series, constraint: Constraint) -> list[Measurement]:
    """Forced queries have no variant: they stand in every column of their method. C = 1 is the base of a network
    that is asked for it."""
    if constraint in (BASE, NO_RAYS):
        wanted: tuple[Constraint, ...] = (constraint, 1.0) if constraint == BASE else (constraint,)
        cell = [one for one in measurements if one.constraint in wanted and one.run.series.method == series.method]
        forced = [one for one in cell if one.constraint == constraint]
        return forced or [one for one in cell if one.run.series == series]
    return [one for one in measurements if one.run.series == series and one.constraint == constraint]


def _cell(cell: Sequence[Measurement], constraint: Constraint) -> str:
    """Soft: what was asked for without a cap. Hard: what a shared frame budget of C allowed of what was asked for."""
    if not cell:
        return _NOT_MEASURED
    kinds: tuple[Kind, ...] = ("soft",) if constraint in (BASE, NO_RAYS) else ("soft", "hard")
    return "<br>".join(_reading([one for one in cell if one.kind == kind], kind) for kind in kinds)


def _reading(cell: Sequence[Measurement], kind: Kind) -> str:
    if not cell:
        return f"{kind}: {_NOT_MEASURED}"
    asked = _percent(statistic([one.numbers.soft_cost_pct for one in cell]).mean)
    allowed = _percent(statistic([one.numbers.hard_cost_pct for one in cell]).mean)
    cost = asked if kind == "soft" else f"{allowed} of {asked} asked"
    return rf"{kind} {cost} \| R = {number(statistic([one.value for one in cell]))}"


def _paper_cell(paper: PaperTable, setting: Setting, series: Series, constraint: Constraint) -> str:
    point = paper.get((setting, series.method, constraint))
    return _DASH if point is None else rf"*{point.cost_pct:.1f} % \| R = {point.value:.1f} ± {point.std:.1f}*"


def _with_seeds(stat: Statistic | None) -> str:
    return _DASH if stat is None else number(stat)


def _percent(share_pct: float) -> str:
    return f"{share_pct:.1f} %" if share_pct >= 0.95 or share_pct == 0.0 else f"{share_pct:.2g} %"


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A table whose first row is its head."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
