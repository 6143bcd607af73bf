"""The form of a shard: a Parquet file, a row a timestep, whose row groups hold whole episodes.

Columns: `episode` (counted from 0 over all shards), `timestep` (from 0), `free`, `costly` and `actions` as lists of one
length, `returns_to_go`. What has no numbers has no column. This module knows nothing about what the numbers mean.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.datasets import TracesError
from training.steps import Layout, Steps, costly_type

__all__ = ["Group", "ShardWriter", "read_group", "step_bytes"]

_FOOTER_BYTES = 2**26  # and entries of a list in it


class Group(NamedTuple):
    """One row group: whole episodes, one after another."""

    steps: Steps
    first: int  # episode that it begins with
    starts_E: NDArray[np.int64]  # first step of each episode
    lengths_E: NDArray[np.int64]


def step_bytes(layout: Layout) -> int:
    """What a timestep takes in memory."""
    features, action = layout.features, layout.action
    return 4 * (features.n_free + action.size + 1) + np.dtype(costly_type(features)).itemsize * features.n_costly


class ShardWriter:
    """One shard that is being written, a row group at a time."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self._schema = _schema(layout)
        # Dictionaries and statistics of columns cost time and tell nothing of such numbers.
        self._file = pq.ParquetWriter(path, self._schema, use_dictionary=False, write_statistics=False)

    def write(self, first: int, episodes: list[Steps]) -> None:
        """Write a row group of these episodes, of which `first` is the number of the first."""
        lengths = [len(episode.returns_to_go_T) for episode in episodes]
        steps = Steps.joined(episodes)
        arrays = {
            "episode": np.repeat(np.arange(first, first + len(lengths)), lengths),
            "timestep": np.concatenate([np.arange(n) for n in lengths]),
            "free": steps.free_TF.numpy(),
            "costly": steps.costly_TD.numpy(),
            "actions": steps.actions_TA.numpy(),
            "returns_to_go": steps.returns_to_go_T.numpy(),
        }
        columns = [_column(arrays[field.name], field.type) for field in self._schema]
        self._file.write_table(pa.table(columns, schema=self._schema), row_group_size=len(steps.returns_to_go_T))

    def close(self) -> None:
        """Without it the file is none."""
        self._file.close()


def read_group(path: Path, number: int, layout: Layout, n_steps: int) -> Group:
    """Read a row group of `n_steps` timesteps. Raises TracesError naming the file, the row group and the column."""
    where, schema = f"{path}: row group {number}", _schema(layout)
    try:
        with pq.ParquetFile(
            path,
            pre_buffer=False,
            thrift_string_size_limit=_FOOTER_BYTES,
            thrift_container_size_limit=_FOOTER_BYTES,
        ) as file:
            _check(where, file, number, schema, n_steps)
            table = file.read_row_group(number, use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise TracesError(f"{where}: {error}") from error
    columns = {field.name: _numbers(table.column(field.name), field.type) for field in schema}
    for name, column in columns.items():
        if not column.isfinite().all():
            raise TracesError(f"{where}: column {name!r} has numbers that are not finite")
    starts_E = _starts(where, columns["episode"].numpy(), columns["timestep"].numpy())
    nothing = torch.empty(n_steps, 0)
    steps = Steps(*(columns.get(name, nothing) for name in ("free", "costly", "actions", "returns_to_go")))
    return Group(steps, int(columns["episode"][0]), starts_E, np.diff(starts_E, append=n_steps))


def _schema(layout: Layout) -> pa.Schema:
    features = layout.features
    lists = {
        "free": (pa.float32(), features.n_free),
        "costly": (pa.from_numpy_dtype(costly_type(features)), features.n_costly),
        "actions": (pa.float32(), layout.action.size),
    }
    kinds = {"episode": pa.int64(), "timestep": pa.int32()}
    # Nothing can be missing: what can be takes twice as long to read.
    kinds |= {n: pa.list_(pa.field("element", kind, nullable=False), size) for n, (kind, size) in lists.items() if size}
    kinds |= {"returns_to_go": pa.float32()}
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in kinds.items()])


def _column(array: NDArray, kind: pa.DataType) -> pa.Array:
    if pa.types.is_fixed_size_list(kind):
        return pa.FixedSizeListArray.from_arrays(pa.array(array.ravel(), kind.value_type), type=kind)
    return pa.array(array, kind)


def _check(where: str, file: pq.ParquetFile, number: int, schema: pa.Schema, n_steps: int) -> None:
    """A few bytes can stand for a column of any length: what the footer says is looked at before anything is read."""
    if not file.schema_arrow.equals(schema):
        raise TracesError(f"{where}: columns are {_shown(file.schema_arrow)}, expected {_shown(schema)}")
    if number >= file.metadata.num_row_groups:
        raise TracesError(f"{where}: the file has {file.metadata.num_row_groups} row groups")
    group = file.metadata.row_group(number)
    if group.num_rows != n_steps:
        raise TracesError(f"{where}: {group.num_rows} rows, expected {n_steps}")
    for i, field in enumerate(schema):
        size = field.type.list_size if pa.types.is_fixed_size_list(field.type) else 1
        if group.column(i).num_values != n_steps * size:
            raise TracesError(
                f"{where}: column {field.name!r} has {group.column(i).num_values} numbers, expected {n_steps * size}"
            )


def _shown(schema: pa.Schema) -> str:
    return ", ".join(f"{field.name} ({field.type})" for field in schema)[:400]


def _numbers(column: pa.ChunkedArray, kind: pa.DataType) -> Tensor:
    flat = column.combine_chunks()
    if pa.types.is_fixed_size_list(kind):
        return torch.from_dlpack(flat.flatten()).view(-1, kind.list_size)
    return torch.from_dlpack(flat)


def _starts(where: str, episode_S: NDArray[np.int64], timestep_S: NDArray[np.int32]) -> NDArray[np.int64]:
    """First step of each episode; every row must follow the one before it."""
    begins_S = timestep_S == 0
    right_S = begins_S.copy()  # an episode's first timestep, of the next episode; or the next timestep of the same one
    right_S[1:] = np.diff(episode_S) == begins_S[1:]
    right_S[1:] &= begins_S[1:] | (np.diff(timestep_S) == 1)
    if not right_S.all():
        row = int(right_S.argmin())
        raise TracesError(
            f"{where}: row {row} is timestep {timestep_S[row]} of episode {episode_S[row]}, expected what follows the "
            "row before it"
        )
    return np.flatnonzero(begins_S)
