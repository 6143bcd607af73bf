"""A picture of one run: Δ, φ, γ and the cost of what is asked for, by update."""

from __future__ import annotations

import json
from pathlib import Path

from matplotlib.figure import Figure

from training.config import TrainConfig

__all__ = ["plot_curves"]

_PANELS = (
    ("delta", "action loss Δ"),
    ("cost", "query cost (share of full)"),
    ("phi", "penalty φ"),
    ("gamma", "penalty weight γ"),
)


def plot_curves(metrics: Path, out: Path, config: TrainConfig) -> None:
    """Read metrics.jsonl, write a PNG."""
    lines = [json.loads(line) for line in metrics.read_text().splitlines()]
    figure = Figure(figsize=(9, 6), layout="constrained")
    figure.suptitle(f"{config.name}: {config.dataset.name}, C = {config.budget:g}, ε = {config.penalty_step:g}")
    for axes, (key, label) in zip(figure.subplots(2, 2).flat, _PANELS, strict=True):
        axes.plot([line["update"] for line in lines], [line[key] for line in lines])
        if key == "delta" and all("held_out" in line for line in lines):
            axes.plot([line["update"] for line in lines], [line["held_out"] for line in lines], label="held out")
            axes.legend()
        if key == "cost":
            axes.axhline(config.budget, linestyle="--", color="tab:red", label="budget C")
            axes.legend()
        axes.set_xlabel("update")
        axes.set_title(label)
        axes.grid(alpha=0.3)
    figure.savefig(out, dpi=100)
