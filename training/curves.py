"""Pictures of training: Δ, φ, γ and the cost of what is asked for, by update; of one run, or of many side by side.

Where the budget is an input, cost and γ are those of each stratum of C: what it spends as a share of its C, and its
own weight. This module knows nothing about evaluations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from training.config import TrainConfig
from training.metrics import Line, read_metrics
from training.results import Run

__all__ = ["PANELS", "budget_colours", "draw_run", "finish_panels", "plot_curves", "training_figure"]

PANELS = ("delta", "cost", "phi", "gamma")
_TITLES = {"delta": "action loss Δ", "cost": "query cost, share of full", "phi": "penalty φ", "gamma": "weight γ"}
_STRATUM_COST = "query cost / C"
_LINEAR_WEIGHT = 0.02  # as training.control has it
_LINEAR_BELOW = 1e-3  # share of the full cost: a logarithm has no 0


def plot_curves(metrics: Path, out: Path, config: TrainConfig) -> None:
    """Read metrics.jsonl, write a PNG."""
    budgets = f"C in {config.budgets[0]:g} to {config.budgets[-1]:g}" if config.budgets else f"C = {config.budget:g}"
    figure = Figure(figsize=(9, 6), layout="constrained")
    figure.suptitle(f"{config.name}: {config.dataset.name}, {budgets}, {config.control}, ε = {config.penalty_step:g}")
    axes = dict(zip(PANELS, figure.subplots(2, 2).flat, strict=True))
    colours = budget_colours(config.budgets[:-1] if config.budgets else [config.budget])
    draw_run(axes, read_metrics(metrics), config, colours, with_held_out=True)
    finish_panels(axes, [config])
    figure.savefig(out, dpi=100)


def budget_colours(budgets: Sequence[float]) -> dict[float, Any]:
    """One colour for each C (or for each stratum's lower edge), dark where it is small."""
    ordered = sorted(set(budgets))
    return {budget: colormaps["viridis"](0.85 * i / max(len(ordered) - 1, 1)) for i, budget in enumerate(ordered)}


def draw_run(
    axes: Mapping[str, Axes],
    lines: Sequence[Line],
    config: TrainConfig,
    colours: Mapping[float, Any],
    *,
    with_held_out: bool = False,
) -> None:
    """Add one run to the four panels; `colours` has its C, or the lower edge of each of its strata."""
    for panel in PANELS:
        if config.budgets and panel in ("cost", "gamma"):
            key = {"cost": "spent", "gamma": "gamma"}[panel]
            for i, (low, high) in enumerate(pairwise(config.budgets)):
                _line(axes[panel], lines, f"{key}_{i}", color=colours[low], label=f"C {low:g} to {high:g}")
        else:
            fixed = {} if config.budgets else {"color": colours[config.budget], "label": f"C = {config.budget:g}"}
            _line(axes[panel], lines, panel, **fixed)
    if not config.budgets:
        axes["cost"].axhline(config.budget, linestyle="--", linewidth=1, color=colours[config.budget])
    if with_held_out:
        _line(axes["delta"], lines, "held_out", color="tab:orange", label="held out")


def finish_panels(axes: Mapping[str, Axes], configs: Sequence[TrainConfig]) -> None:
    """Titles, scales and the legend, once the runs of these configurations, all of one series, are drawn."""
    config, costs = configs[0], {config.budget for config in configs}
    for panel, each in axes.items():
        each.set_title(_STRATUM_COST if config.budgets and panel == "cost" else _TITLES[panel], fontsize=10)
        each.set_xlabel("update")
        each.grid(alpha=0.3)
    if config.control == "dual":
        axes["gamma"].set_yscale("symlog", linthresh=_LINEAR_WEIGHT)  # it moves by factors, and may pass zero
    if config.budgets:
        axes["cost"].axhline(1.0, linestyle="--", linewidth=1, color="grey")
        axes["cost"].set_yscale("log")  # from a hundred times C to C
    elif len(costs) > 1 and min(costs) > 0.0:
        axes["cost"].set_yscale("log")  # C of 0.5 and of 0.01 in one picture
    elif len(costs) > 1:
        axes["cost"].set_yscale("symlog", linthresh=_LINEAR_BELOW)  # and of 0
        axes["cost"].set_ylim(bottom=-_LINEAR_BELOW / 10)
    by_label = {"C": Line2D([], [], linestyle="--", color="grey")}
    for panel in ("cost", "delta"):
        handles, labels = axes[panel].get_legend_handles_labels()
        by_label |= dict(zip(labels, handles, strict=True))  # seeds share a label
    # One legend for all panels, where curves leave room: Δ falls.
    axes["delta"].legend(by_label.values(), by_label.keys(), fontsize=7, loc="upper right")


def training_figure(runs: Sequence[Run]) -> Figure:
    """Runs of one method on one setting, a column for each way in which they were trained. Raises ValueError for none
    with metrics."""
    measured = [run for run in runs if (run.folder / "metrics.jsonl").exists()]
    variants = sorted({run.series.variant for run in measured})
    if not variants:
        raise ValueError("none of the runs has metrics.jsonl, expected one or more that do")
    figure = Figure(figsize=(1.0 + 4.5 * len(variants), 9), layout="constrained")
    grid = figure.subplots(len(PANELS), len(variants), squeeze=False)
    colours = budget_colours([c for run in measured for c in run.config.budgets[:-1] or (run.config.budget,)])
    for column, variant in enumerate(variants):
        axes = dict(zip(PANELS, grid[:, column], strict=True))
        alike = [run for run in measured if run.series.variant == variant]
        for run in alike:
            draw_run(axes, read_metrics(run.folder / "metrics.jsonl"), run.config, colours)
        finish_panels(axes, [run.config for run in alike])
        axes["delta"].set_title(f"{variant or 'algorithm-1'}\n{axes['delta'].get_title()}", fontsize=10)
    return figure


def _line(axes: Axes, lines: Sequence[Line], key: str, **style: Any) -> None:
    """What was not measured at an update (no stratum is in every line) is no point of the curve."""
    points = [(line["update"], line[key]) for line in lines if key in line]
    if points:
        axes.plot(*zip(*points, strict=True), linewidth=1, alpha=0.85, **style)
