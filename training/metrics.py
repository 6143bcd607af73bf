"""metrics.jsonl: a line of JSON for every few updates of a run.

This module knows nothing about what is measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

__all__ = ["Line", "parse_metrics", "read_metrics"]

Line = Mapping[str, float]


def read_metrics(path: Path) -> list[Line]:
    """Every line of a file. Raises ValueError naming the line that is none."""
    return parse_metrics(path, path.read_text().splitlines())


def parse_metrics(path: Path, texts: Iterable[str]) -> list[Line]:
    """One mapping a line of this file; each tells its update. Raises ValueError naming the line that does not."""
    lines: list[Line] = []
    for n, text in enumerate(texts, start=1):
        try:
            line = json.loads(text)
        except ValueError as error:
            raise ValueError(f"{path} line {n}: {error}") from error
        if not isinstance(line, dict) or not isinstance(line.get("update"), int):
            raise ValueError(f"{path} line {n}: expected an object with the number of its update")
        lines.append(line)
    return lines
