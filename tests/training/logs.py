"""Logs as games write them: the same rows as CSV, JSON Lines and Parquet."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from training.column_map import ColumnMap

__all__ = ["COLUMNS", "LISTS", "WRITERS", "column_map", "rows", "write_csv", "write_json", "write_parquet"]

COLUMNS = {
    "episode": "match",
    "timestep": "tick",
    "observation": ["health", "speed"],
    "action": [{"column": "turn", "low": -1, "high": 1}, "fire"],
    "reward": "score",
    "terminated": "died",
    "truncated": "stopped",
}
LISTS = {  # the same match with lists and parts
    "episode": "match",
    "observations": {"body": ["health"], "rays": [{"column": "rays", "size": 3}, "speed"]},
    "action": [{"column": "stick", "size": 2}],
    "reward": "score",
}

Log = list[dict[str, object]]


def rows(*lengths: int) -> Log:
    """Episodes m0, m1, ... of these lengths; every second one ends by `died`, the others by `stopped`."""
    log: Log = []
    for episode, length in enumerate(lengths):
        for t in range(length):
            n, last = len(log), t == length - 1
            log.append(
                {
                    "match": f"m{episode}",
                    "tick": t + 10,
                    "health": 100.0 - n,
                    "speed": n / 8,
                    "turn": (-1.0) ** n,
                    "fire": n % 2 == 1,
                    "score": n / 4,
                    "died": last and episode % 2 == 0,
                    "stopped": last and episode % 2 == 1,
                    "rays": [n + 0.5, 2.0, 3.0],
                    "stick": [n / 16, -1.0],
                }
            )
    return log


def column_map(**fields: object) -> ColumnMap:
    """COLUMNS with some fields different; None leaves one out."""
    told = {name: value for name, value in {**COLUMNS, **fields}.items() if value is not None}
    return msgspec.convert(told, ColumnMap)


def write_csv(path: Path, log: Log) -> Path:
    """Without the columns that are lists."""
    names = [name for name in log[0] if not isinstance(log[0][name], list)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(log)
    return path


def write_json(path: Path, log: Log) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in log), encoding="utf-8")
    return path


def write_parquet(path: Path, log: Log) -> Path:
    pq.write_table(pa.Table.from_pylist(log), path)
    return path


WRITERS: dict[str, Callable[[Path, Log], Path]] = {".csv": write_csv, ".jsonl": write_json, ".parquet": write_parquet}
