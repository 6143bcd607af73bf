"""Sweeps on the toy traces, small enough for tests."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from tests.training import toy

__all__ = ["write_spec"]


def write_spec(
    folder: Path,
    dataset: Path,
    grid: list[dict[str, object]],
    evaluate: dict[str, object] | None = None,
    **base: object,
) -> Path:
    """A spec at folder/spec.json whose runs go to folder/results."""
    config = toy.config(dataset, folder, **{"updates": 4, "log_every": 2, "checkpoint_every": 2, **base})
    settings = {name: value for name, value in asdict(config).items() if name not in ("out", "name")}
    spec = {"out": str(folder / "results"), "base": settings, "grid": grid, "evaluate": evaluate or {}}
    path = folder / "spec.json"
    path.write_text(json.dumps(spec, default=str))
    return path
