"""Figures of a report: return against spend, and what is acquired when. Each comes with a caption of what was measured.

This module knows nothing about files.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from training.heat_map import HeatMap
from training.paper import PaperTable
from training.results import BASE, NO_RAYS, Kind, Measurement, Series, Setting
from training.spend import by_constraint, statistic
from training.tables import METHODS

__all__ = ["LEAST_ALIVE", "Panel", "heat_map_figure", "performance_figure", "ray_order"]

LEAST_ALIVE = 0.1  # share of the episodes: later timesteps are the mean of too few
_LEAST_PCT = 0.01  # the logarithmic axis never begins before; what spends less is drawn at its left end
_OFFSETS = ((3, 4), (3, -9), (-13, 4), (-13, -9))  # points between a point and its C, another for each series
_COLOURS = dict(zip(METHODS, colormaps["tab10"].colors, strict=False))  # type: ignore[attr-defined]
_DASHES = ("-", "--", ":", "-.")
_MARKERS = {"BDT": "o", "RCBC": "s", "BDT random": "D"}  # of the paper's points
_SIDE_DEG = 45  # directions that are labelled
_RAY = re.compile(r"ray_(?P<side>[lr])(?P<azimuth>\d+)_(?P<tilt>[du])(?P<pitch>\d+)_r(?P<range>\d+)")


class Panel(NamedTuple):
    """One heat map and what stands above it."""

    title: str
    heat: HeatMap


def performance_figure(measurements: Sequence[Measurement], setting: Setting, paper: PaperTable) -> Figure:
    """Spend % on a logarithmic axis against return: left what is asked for, right what a hard budget allows."""
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    least_pct = _least_pct(measurements, setting, paper)
    kinds: tuple[Kind, ...] = ("soft", "hard")
    titles = ("soft: as asked for, no cap", "hard: one frame budget of C shared by all bots")
    for each, kind, title in zip(axes, kinds, titles, strict=True):
        _draw_series(each, [one for one in measurements if one.kind == kind], least_pct)
        _draw_forced(each, measurements)
        each.set_xscale("log")
        each.set_xlim(least_pct / 1.5, 180.0)
        each.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        each.set_xlabel("cost of what is asked for, %" if kind == "soft" else "cost of what is allowed, %")
        each.set_title(f"{setting}, {title}", fontsize=10)
        each.grid(alpha=0.2, which="both")
    _draw_paper(axes[0], setting, paper)
    axes[0].set_ylabel("normalised return" if any(one.is_normalised for one in measurements) else "return")
    handles = {label: handle for each in axes for handle, label in zip(*each.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def heat_map_figure(panels: Sequence[Panel]) -> Figure:
    """Features by timesteps, one panel beside the other on one colour scale; timesteps that few episodes reach are
    left out. Raises ValueError for no panels, or for panels of different features."""
    if len({panel.heat.names for panel in panels}) != 1:
        raise ValueError(f"{len(panels)} heat maps of different features or none, expected some of the same")
    order_M = ray_order(panels[0].heat.names)
    shown = [_reached(panel.heat)[:, order_M].T for panel in panels]
    names = [panels[0].heat.names[i] for i in order_M]
    height = min(max(0.085 * len(names), 3.0), 11.0)
    figure = Figure(figsize=(1.6 + 5.2 * len(panels), height + 1.0), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    # Small probabilities are most of the picture where the budget is small: the square root tells them apart.
    norm = PowerNorm(0.5, vmin=0.0, vmax=max(max(float(probs.max()) for probs in shown), 1e-3))
    for each, panel, probs in zip(axes, panels, shown, strict=True):
        image = each.imshow(probs, aspect="auto", norm=norm, cmap="magma", interpolation="nearest")
        each.set_title(panel.title, fontsize=10)
        each.set_xlabel("timestep")
        _label_features(each, names, with_labels=each is axes[0])
    if all(_RAY.fullmatch(name) for name in names):
        axes[0].set_ylabel("rays by range, within a range from left to right")
    figure.colorbar(image, ax=list(axes), label="mean query probability")
    return figure


def ray_order(names: Sequence[str]) -> list[int]:
    """Indices that sort rays by range, then from left to right; other features follow in their own order."""

    def key(index: int) -> tuple[int, ...]:
        ray = _RAY.fullmatch(names[index])
        return (0, int(ray["range"]), _right_deg(ray), index) if ray else (1, 0, 0, index)

    return sorted(range(len(names)), key=key)


def _least_pct(measurements: Iterable[Measurement], setting: Setting, paper: PaperTable) -> float:
    """Left end of the logarithmic axis, a little below the smallest spend above 0; what spends 0 is drawn there."""
    spends = [one.spend_pct for one in measurements] + [
        point.cost_pct for key, point in paper.items() if key[0] == setting
    ]
    return 0.7 * max(min((spend for spend in spends if spend > 0.0), default=1.0), _LEAST_PCT)


def _draw_series(axes: Axes, measurements: Iterable[Measurement], least_pct: float) -> None:
    learned = [one for one in measurements if one.constraint not in (BASE, NO_RAYS)]
    for (series, colour, dash), offset in zip(_styles({one.run.series for one in learned}), cycle(_OFFSETS)):
        groups = by_constraint(one for one in learned if one.run.series == series)
        spends = [statistic([one.spend_pct for one in group]) for group in groups.values()]
        returns = [statistic([one.value for one in group]) for group in groups.values()]
        x = np.maximum([spend.mean for spend in spends], least_pct)
        y = np.array([value.mean for value in returns])
        along = np.argsort(x, kind="stable")
        above = along[np.array([spends[i].mean > least_pct for i in along], dtype=bool)]
        axes.plot(x[above], y[above], color=colour, linestyle=dash, linewidth=1.3)  # no line to a spend of 0
        right = np.array([spend.std or 0.0 for spend in spends])
        bars = np.array([np.minimum(right, 0.9 * x), right])  # a logarithm ends before 0
        heights = np.array([value.std or 0.0 for value in returns])
        points = {"color": colour, "linestyle": "none", "marker": "o", "markersize": 4, "capsize": 2, "elinewidth": 0.8}
        axes.errorbar(x, y, heights, bars, **points)
        axes.plot([], [], color=colour, linestyle=dash, marker="o", markersize=4, label=str(series))
        for constraint, at_x, at_y in zip(groups, x, y, strict=True):
            text = f"{100 * float(constraint):g}"
            axes.annotate(text, (at_x, at_y), offset, textcoords="offset points", fontsize=7, color=colour)


def _draw_forced(axes: Axes, measurements: Iterable[Measurement]) -> None:
    """All features is a point at 100 %; none has no place on a logarithmic axis, and is a line across it."""
    forced = [one for one in measurements if one.constraint in (BASE, NO_RAYS)]
    for series, colour, _ in _styles({one.run.series for one in forced}):
        for constraint, group in by_constraint(one for one in forced if one.run.series == series).items():
            value = statistic([one.value for one in group])
            if constraint == BASE:
                axes.errorbar(
                    [100.0], [value.mean], [value.std or 0.0], color=colour, marker="*", markersize=9, linestyle="none",
                    capsize=2, label=f"{series}, all features",
                )  # fmt: skip
            else:
                axes.axhline(value.mean, color=colour, linestyle=(0, (1, 4)), label=f"{series}, no costly features")


def _draw_paper(axes: Axes, setting: Setting, paper: PaperTable) -> None:
    for method, marker in _MARKERS.items():
        points = [point for (where, name, _), point in paper.items() if (where, name) == (setting, method)]
        if points:
            x, y, std = zip(*(point[:3] for point in points), strict=True)
            axes.errorbar(
                x, y, std, linestyle="none", marker=marker, markersize=7, capsize=2,
                color=_COLOURS[method], markerfacecolor="none", alpha=0.6, label=f"{method}, the paper's",
            )  # fmt: skip


def _styles(series: Iterable[Series]) -> list[tuple[Series, Any, str]]:
    """A colour a method, the same in every figure; a dash pattern a variant."""
    ordered = sorted(series, key=lambda one: (_rank(one.method), one))
    spare, styled = cycle(colormaps["Dark2"].colors), []  # type: ignore[attr-defined]
    colours = {one.method: _COLOURS.get(one.method) for one in ordered}
    colours = {method: colour or next(spare) for method, colour in colours.items()}
    for one in ordered:
        variants = [other.variant for other in ordered if other.method == one.method]
        styled.append((one, colours[one.method], _DASHES[variants.index(one.variant) % len(_DASHES)]))
    return styled


def _rank(method: str) -> int:
    return METHODS.index(method) if method in METHODS else len(METHODS)


def _reached(heat: HeatMap) -> np.ndarray[Any, np.dtype[np.float32]]:
    """The timesteps that enough of the episodes reach, [T, M]."""
    return heat.probs_TM[: int((heat.alive_T >= LEAST_ALIVE * heat.alive_T[0]).sum())]


def _right_deg(ray: re.Match[str]) -> int:
    return int(ray["azimuth"]) * (-1 if ray["side"] == "l" else 1)


def _label_features(axes: Axes, names: Sequence[str], *, with_labels: bool) -> None:
    """Rays: the range of each group of rows, and two directions within it; other features: their names."""
    groups: dict[str, list[int]] = {}
    sides: dict[int, str] = {}
    for row, name in enumerate(names):
        ray = _RAY.fullmatch(name)
        groups.setdefault(f"{int(ray['range'])} m" if ray else name, []).append(row)
        if ray and abs(_right_deg(ray)) == _SIDE_DEG:
            sides[row] = f"{_SIDE_DEG}° {'left' if ray['side'] == 'l' else 'right'}"
    centres = {float(np.mean(rows)): label for label, rows in groups.items()}
    for ticks, size, is_minor in ((centres, 9, False), (sides, 6, True)):
        labels = list(ticks.values()) if with_labels else [""] * len(ticks)
        axes.set_yticks(list(ticks), labels, minor=is_minor, fontsize=size)
    for rows in list(groups.values())[1:]:
        axes.axhline(rows[0] - 0.5, color="white", linewidth=0.6)
    axes.tick_params(axis="y", which="both", length=2)
