"""A game's own log into a Minari dataset: `python -m training.import_traces LOG OUT --columns COLUMNS.json`.

LOG is CSV, JSON Lines or Parquet, one row a timestep; COLUMNS.json says what its columns hold (training/column_map.py,
docs/importing.md). The log is read once, an episode at a time; OUT appears when all of it is right, or not at all.
This module knows nothing about features and their costs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import tyro
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from training.column_map import LARGEST, ColumnMap
from training.command import command, terminable
from training.dataset_writer import DatasetWriter
from training.episodes import Episode, cut
from training.rows import Row, RowBatch, SourceError
from training.source import read_rows

__all__ = ["ImportConfig", "Imported", "import_traces", "main"]


@dataclass(frozen=True)
class ImportConfig:
    """What is imported, and where to."""

    source: tyro.conf.Positional[Path]  # .csv, .jsonl or .parquet
    out: tyro.conf.Positional[Path]  # folder of the dataset, named as Minari names one: data/arena-expert-v0
    columns: Path  # JSON file, the column map: see docs/importing.md


@dataclass(frozen=True)
class Imported:
    """What a dataset holds."""

    lengths: tuple[int, ...]  # of each episode, in timesteps
    returns: tuple[float, ...]  # of each episode
    terminated: int  # episodes; the others were truncated
    action_names: tuple[str, ...]
    action_range: tuple[NDArray[np.float32], NDArray[np.float32]]  # lowest and highest seen, each [A]


def import_traces(config: ImportConfig, console: Console | None = None) -> Imported:
    """Read the log, write the dataset. Raises ValueError (SourceError for the log), OSError; then OUT is not there."""
    with DatasetWriter(config.out) as writer:
        columns = ColumnMap.read(config.columns)
        batches = read_rows(config.source, columns)
        with _progress(console or Console()) as progress:
            imported = _write_episodes(writer, cut(_watched(batches, progress, config), columns), columns)
        if not imported.lengths:
            raise SourceError(f"{config.source} has no rows, expected one or more")
        writer.finish(
            (_observation_space(columns), _action_space(columns, imported)),
            {"import": {"source": config.source.name, "columns": msgspec.to_builtins(columns)}},
            None if columns.environment is None else EnvSpec(columns.environment),
        )
    return imported


def _watched(batches: Iterable[RowBatch], progress: Progress, config: ImportConfig) -> Iterator[Row]:
    task = progress.add_task(f"importing {escape(config.source.name)}", total=1.0)
    for batch in batches:
        yield from batch.rows
        progress.update(task, completed=batch.done)


def _progress(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console)


def _write_episodes(writer: DatasetWriter, episodes: Iterable[Episode], columns: ColumnMap) -> Imported:
    """Write every episode; count what passes."""
    names = tuple(label for column in columns.actions for label in column.labels)
    low_A = np.full(len(names), np.inf, np.float32)
    high_A, lengths, returns, terminated = -low_A, [], [], 0
    for episode in episodes:
        writer.add(episode)
        lengths.append(len(episode.rewards))
        returns.append(float(episode.rewards.sum(dtype=np.float64)))
        terminated += episode.terminated
        low_A = np.minimum(low_A, episode.actions.min(axis=0))
        high_A = np.maximum(high_A, episode.actions.max(axis=0))
    return Imported(tuple(lengths), tuple(returns), terminated, names, (low_A, high_A))


def _observation_space(columns: ColumnMap) -> spaces.Space:
    boxes = {
        key: spaces.Box(-np.inf, np.inf, (sum(column.width for column in part),), np.float32)
        for key, part in columns.observed.items()
    }
    return boxes[""] if "" in boxes else spaces.Dict(boxes)


def _action_space(columns: ColumnMap, imported: Imported) -> spaces.Space:
    """Choices or a range, as the column map says; where it says none, the range seen. Raises SourceError for none."""
    if columns.choices is not None:
        return spaces.Discrete(columns.choices)
    declared_A = columns.action_range
    low_A, high_A = (
        np.where(np.abs(declared) < LARGEST, declared, seen).astype(np.float32)
        for declared, seen in zip(declared_A, imported.action_range, strict=True)
    )
    for name, low, high in zip(imported.action_names, low_A, high_A, strict=True):
        if not low < high:
            raise SourceError(f"action {name!r} is {low:g} in every row, expected its low and high in the column map")
    return spaces.Box(low_A, high_A, dtype=np.float32)


def _line(imported: Imported, out: Path) -> str:
    episodes = len(imported.lengths)
    ends = f"{imported.terminated} terminated, {episodes - imported.terminated} truncated"
    return f"{escape(str(out))}: {episodes} episodes ({ends}), {sum(imported.lengths)} steps"


def _table(imported: Imported) -> Table:
    table = Table(box=None)
    table.add_column("")
    for name in ("mean", "min", "max"):
        table.add_column(name, justify="right")
    for name, values in (("steps of an episode", imported.lengths), ("return", imported.returns)):
        table.add_row(name, *(f"{number:.6g}" for number in (np.mean(values), min(values), max(values))))
    for name, low, high in zip(imported.action_names, *imported.action_range, strict=True):
        table.add_row(f"action {escape(name)}", "", f"{low:.6g}", f"{high:.6g}")
    return table


def main(arguments: list[str] | None = None) -> None:
    """Command line: a table of what was imported."""
    console = Console()
    with command("stopped: nothing was written"), terminable():
        config = tyro.cli(ImportConfig, args=arguments, description=__doc__)
        imported = import_traces(config, console)
    console.print(_line(imported, config.out), soft_wrap=True)
    console.print(_table(imported))


if __name__ == "__main__":
    main()
