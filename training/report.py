"""Tables and figures of a folder of results, beside the paper's: `python -m training.report runs/navigation`.

Writes report.md, and every figure as PNG and SVG. This module knows nothing about how anything was trained or measured.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import tyro
from matplotlib.figure import Figure

from training.command import command
from training.curves import training_figure
from training.figures import LEAST_ALIVE, Panel, heat_map_figure, performance_figure
from training.group_table import group_table
from training.heat_map import HeatMap
from training.paper import PaperTable, read_paper, shown_beside
from training.results import Kind, Measurement, Results, Run, Setting
from training.tables import cost_table, spend_table

__all__ = ["ReportConfig", "report"]

_HEAD = """# Results

`soft` is what the network asks for where nothing is capped; `hard` is one frame budget of C, shared by all bots that
play at once, and shows what it allowed of what was asked for. R is the mean return. ± is the sample standard deviation
over training seeds, n of them; one seed has none. Costs are shares of the cost of all features, averaged over frames.
Where a run has reference returns R is normalised: they are 0 and 100.
"""
_PAPER = "\nFigures in *italics* and hollow markers are the paper's own, measured in its own environment.\n"
_SAME_COST = 1e-4  # relative: a heat map is rounded to float32, and no two evaluations spend the same


@dataclass(frozen=True)
class ReportConfig:
    """What is reported, and where to."""

    results: tyro.conf.Positional[Path]  # folder of run folders, or one of them
    paper: tuple[Path, ...] = ()  # tables of the paper as CSV (none: without the paper's figures)
    paper_dataset: str = ""  # the paper's dataset shown beside ours of other names (empty: beside its namesake only)
    out: Path | None = None  # folder of report.md and figures/ (None: `report` in the folder of results)
    spends: tuple[float, ...] = (1.0, 2.0, 2.9, 5.0, 10.0)  # % of the full cost, for returns at equal spend

    def __post_init__(self) -> None:
        if not self.spends or min(self.spends) <= 0.0:
            raise ValueError(f"spends is {self.spends}, expected one or more above 0 %")


def report(config: ReportConfig) -> Path:
    """Write everything; the path of report.md. Raises ValueError naming a file that is not as it should be."""
    results = Results.read(config.results)
    paper = shown_beside(read_paper(*config.paper), config.paper_dataset, results.settings)
    out = config.out or config.results / "report"
    (out / "figures").mkdir(parents=True, exist_ok=True)
    parts = [_HEAD + (_PAPER if paper else "")]
    for setting in results.settings:
        parts += [f"## {setting}\n", *_setting(results, setting, paper, config.spends, out)]
    if results.skipped:
        names = ", ".join(str(path.relative_to(config.results)) for path in results.skipped)
        parts.append(f"Evaluations whose label is neither `soft-<C>` nor `hard-<C>`, left out: {names}.\n")
    path = out / "report.md"
    path.write_text("\n".join(parts), encoding="utf-8")
    return path


def _setting(
    results: Results, setting: Setting, paper: PaperTable, spends: Sequence[float], out: Path
) -> Iterator[str]:
    """Every part of one map and dataset."""
    measurements = results.of(setting)
    runs = [run for run in results.runs if run.setting == setting]
    yield "### Cost and return\n"
    yield cost_table(measurements, setting, paper)
    yield f"{_measured(measurements)} {_violations(measurements)}\n"
    if groups := group_table(measurements, setting, paper):
        yield "### Features of each group\n"
        yield "Mean share of a group's features that are acquired in a frame; nothing is capped.\n"
        yield groups
    if measurements:
        yield from _at_equal_spend(measurements, setting, paper, spends)
        caption = (
            "Return against spend, mean over training seeds, bars their standard deviation; numbers at the points are "
            f"C in %, and what spends nothing is drawn at the left end. {_measured(measurements)}"
        )
        yield _figure(performance_figure(measurements, setting, paper), out, f"performance-{setting}", caption)
    yield from _heat_maps(runs, measurements, setting, out)
    yield from _training(runs, setting, out)


def _at_equal_spend(
    measurements: Sequence[Measurement], setting: Setting, paper: PaperTable, spends: Sequence[float]
) -> Iterator[str]:
    yield "### Return at equal spend\n"
    kinds: dict[Kind, str] = {"soft": "Spend is what is asked for, no cap.", "hard": "Spend is what is allowed, hard."}
    for kind, meaning in kinds.items():
        yield f"{meaning} {_measured([one for one in measurements if one.kind == kind])}\n"
        yield spend_table(measurements, setting, kind, spends, paper)
    yield (
        "Interpolated on each seed's own curve, linear in the logarithm of the spend; a dash where no seed's curve "
        "reaches that spend, and n counts those that do.\n"
    )


def _heat_maps(runs: Sequence[Run], measurements: Sequence[Measurement], setting: Setting, out: Path) -> Iterator[str]:
    """One figure a C: the first seed of each series, side by side."""
    by_cost: dict[str, dict[str, tuple[Run, HeatMap]]] = defaultdict(dict)
    for run in sorted(runs, key=lambda run: (run.config.method, run.series, run.config.seed)):
        if (run.folder / "heat_map.npz").exists():
            heat = HeatMap.read(run.folder / "heat_map.npz")
            by_cost[_heat_map_cost(run, heat, measurements)].setdefault(str(run.series), (run, heat))
    for cost, shown in sorted(by_cost.items()):
        panels = [Panel(f"{name}\n{setting}, C = {cost}", heat) for name, (_, heat) in shown.items()]
        episodes = _range(int(heat.alive_T[0]) for _, heat in shown.values())
        seeds = _list(run.config.seed for run, _ in shown.values())
        caption = (
            f"Query probability of each feature at each timestep, mean over the episodes alive then (timesteps that "
            f"{LEAST_ALIVE:.0%} of them reach), C = {cost}. {episodes} episodes, training seed {seeds}."
        )
        yield _figure(heat_map_figure(panels), out, f"heat-map-{setting}-c{cost}", caption)


def _heat_map_cost(run: Run, heat: HeatMap, measurements: Iterable[Measurement]) -> str:
    """C that a heat map was made at: the run's own, or that of the evaluation that asked for as much."""
    if not run.config.budgets:
        return f"{run.config.budget:g}"
    made = [
        one.constraint
        for one in measurements
        if one.run is run and math.isclose(one.numbers.soft_cost_pct, heat.cost_pct, rel_tol=_SAME_COST)
    ]
    return f"{made[0]:g}" if made and not isinstance(made[0], str) else "unknown"


def _training(runs: Sequence[Run], setting: Setting, out: Path) -> Iterator[str]:
    """One figure a method whose queries were learned, its controls side by side."""
    groups: dict[str, list[Run]] = defaultdict(list)
    for run in runs:
        if run.config.acquisition == "learned" and (run.folder / "metrics.jsonl").exists():
            groups[run.series.method].append(run)
    for method, alike in sorted(groups.items()):
        caption = (
            f"{method} on {setting}: training by update, one line a run (a stratum of C where the budget is an input), "
            f"C dashed. Training seeds {_list(run.config.seed for run in alike)}; windows of the traces, no episodes "
            "played."
        )
        yield _figure(training_figure(alike), out, f"training-{method}-{setting}", caption)


def _figure(figure: Figure, out: Path, title: str, caption: str) -> str:
    """Write a figure as PNG and SVG; the Markdown that shows it."""
    name = re.sub(r"[^a-z0-9.]+", "-", title.lower())
    with matplotlib.rc_context({"svg.hashsalt": name}):  # the same figure is the same file
        figure.savefig(out / "figures" / f"{name}.png", dpi=150)
        figure.set_layout_engine("none")  # it is laid out now
        figure.savefig(out / "figures" / f"{name}.svg", metadata={"Date": None})
    return f"![{caption}](figures/{name}.png)\n\n*{caption}* ([SVG](figures/{name}.svg))\n"


def _measured(measurements: Sequence[Measurement]) -> str:
    """How many episodes and seeds stand behind numbers."""
    if not measurements:
        return "Nothing was measured."
    episodes = _range(one.numbers.episodes for one in measurements)
    seeds = _list(one.seed for one in measurements)
    if len(measurements) == 1:
        return f"One evaluation of {episodes} episodes, training seed {seeds}."
    return f"{len(measurements)} evaluations of {episodes} episodes each, training seeds {seeds}."


def _violations(measurements: Sequence[Measurement]) -> str:
    hard = [one for one in measurements if one.kind == "hard"]
    return f"Frames that passed a hard budget: {sum(one.numbers.violations for one in hard)}." if hard else ""


def _list(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(set(numbers))))


def _range(numbers: Iterable[int]) -> str:
    ordered = sorted(set(numbers))
    return str(ordered[0]) if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def main() -> None:
    """Command line: prints the path of the report."""
    with command():
        print(report(tyro.cli(ReportConfig, description=__doc__)))


if __name__ == "__main__":
    main()
