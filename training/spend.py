"""Statistics over training seeds, and returns at equal spend.

This module knows nothing about files, tables or figures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from training.results import BASE, NO_RAYS, Constraint, Measurement

__all__ = ["Statistic", "at_spend", "by_constraint", "return_at", "statistic"]


class Statistic(NamedTuple):
    """Mean and sample standard deviation (n - 1) over n training seeds; one seed has no deviation."""

    mean: float
    std: float | None
    n: int


def statistic(numbers: Sequence[float]) -> Statistic:
    """Of one number a seed. Raises ValueError for none."""
    if not numbers:
        raise ValueError("no numbers, expected one a seed")
    std = float(np.std(numbers, ddof=1)) if len(numbers) > 1 else None
    return Statistic(float(np.mean(numbers)), std, len(numbers))


def by_constraint(measurements: Iterable[Measurement]) -> dict[Constraint, list[Measurement]]:
    """Measurements of the same constraint together, the dearest constraint first."""
    groups: dict[Constraint, list[Measurement]] = defaultdict(list)
    for one in measurements:
        groups[one.constraint].append(one)
    return dict(sorted(groups.items(), key=lambda item: -_order(item[0])))


def return_at(spend_pct: float, points: Iterable[tuple[float, float]]) -> float | None:
    """Return at this spend on a curve of (spend %, return) points, linear in the logarithm of the spend.

    None outside of the measured range: nothing is extrapolated. Points of equal spend count as their mean; a point
    that spent nothing has no logarithm and is left out. Raises ValueError unless the spend is above 0.
    """
    if not spend_pct > 0.0:
        raise ValueError(f"spend is {spend_pct} %, expected more than 0")
    returns: dict[float, list[float]] = defaultdict(list)
    for spent, value in points:
        if spent > 0.0:
            returns[spent].append(value)
    spends = sorted(returns)
    if not spends or not spends[0] <= spend_pct <= spends[-1]:
        return None
    means = [float(np.mean(returns[spent])) for spent in spends]
    if spend_pct in returns:
        return means[spends.index(spend_pct)]
    return float(np.interp(np.log(spend_pct), np.log(spends), means))


def at_spend(spend_pct: float, measurements: Iterable[Measurement]) -> Statistic | None:
    """Return of one series at this spend, over those seeds whose own curve reaches it.

    Networks whose queries were forced are no points of a curve: between them and the next nothing was learned.
    """
    curves: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for one in measurements:
        if one.constraint not in (BASE, NO_RAYS):
            curves[one.seed].append((one.spend_pct, one.value))
    reached = [value for curve in curves.values() if (value := return_at(spend_pct, curve)) is not None]
    return statistic(reached) if reached else None


def _order(constraint: Constraint) -> float:
    if isinstance(constraint, str):
        return {BASE: np.inf, NO_RAYS: -1.0}[constraint]
    return constraint
