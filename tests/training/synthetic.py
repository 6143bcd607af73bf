"""A folder of results as a sweep leaves it, made of numbers that a test chooses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from training.config import TrainConfig
from training.heat_map import HeatMap

__all__ = ["NAMES", "write_evaluation", "write_heat_map", "write_metrics", "write_run"]

_RANGES_M, _AZIMUTHS = (1, 5, 10, 25, 50, 100), range(75, -76, -10)
NAMES = tuple(f"ray_{'l' if a > 0 else 'r'}{abs(a):03d}_d10_r{r:03d}" for r in _RANGES_M for a in _AZIMUTHS)


def write_run(results: Path, name: str, dataset: str = "hard-expert-v0", **settings: Any) -> Path:
    """A run folder with its config.json; returns it."""
    folder = results / name
    (folder / "evaluations").mkdir(parents=True)
    TrainConfig(dataset=Path("data") / dataset, out=folder, name=name, **settings).write(folder / "config.json")
    return folder


def write_evaluation(run: Path, label: str, value: float, soft_pct: float, hard_pct: float, **numbers: Any) -> None:
    """evaluations/<label>.json with what a report reads of an Evaluation."""
    kind, cost = label.split("-", 1)
    config = TrainConfig.read(run / "config.json")
    data = {
        "bundle": run.name,
        "episodes": 256,
        "return_mean": value,
        "return_std": 30.0,
        "soft_cost_pct": soft_pct,
        "hard_cost_pct": hard_pct,
        "violations": 0,
        "trained_budget": None if config.budgets else config.budget,
        "target_cost": float(cost) if config.budgets else None,
        "frame_budget": float(cost) if kind == "hard" else None,
        "returns": [value] * 256,
    }
    (run / "evaluations" / f"{label}.json").write_text(json.dumps(data | numbers))


def write_metrics(run: Path, lines: int = 20) -> None:
    """metrics.jsonl of a run that learns; strata where the budget is an input, one of them not in every line."""
    config, strata = TrainConfig.read(run / "config.json"), {}
    with (run / "metrics.jsonl").open("w") as file:
        for n in range(1, lines + 1):
            for i in range(len(config.budgets) - 1):
                strata |= {f"spent_{i}": 1.0 + (i - 1.5) / n, f"gamma_{i}": 10.0 ** (1 - i) * (1 - 0.5 / n)}
            if n == lines:
                strata.pop("spent_1", None)
            line = {"update": 50 * n, "seconds": 1.0 * n, "delta": 1.0 + 1.0 / n, "held_out": 1.1 + 1.0 / n}
            line |= {"cost": config.budget * (1.0 + 2.0 / n), "phi": 0.1 / n, "gamma": 0.02 * n, **strata}
            file.write(json.dumps(line) + "\n")


def write_heat_map(run: Path, seed: int = 0) -> None:
    """A heat map of the game's rays: some are asked for in bursts."""
    random = np.random.default_rng(seed)
    alive_T = np.maximum(256 - np.arange(300), 3)
    worth_M = random.gamma(0.4, 0.1, len(NAMES))
    probs_TM = np.clip(worth_M * (0.5 + random.gamma(0.5, 1.0, (300, 1))), 0.0, 1.0)
    HeatMap(probs_TM.astype(np.float32), alive_T, np.ones(len(NAMES)), NAMES).write(run / "heat_map.npz")
