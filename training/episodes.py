"""Rows into episodes: where each begins and ends, with every number checked. One episode is held at a time.

This module knows nothing about files. Shape letters: T timesteps of an episode, X numbers of a timestep, A action
numbers, n numbers of a part.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from training.column_map import LARGEST, MAX_NAME, ColumnMap
from training.rows import Row, SourceError, shown

__all__ = ["MAX_EPISODES", "MAX_EPISODE_NUMBERS", "Episode", "cut"]

MAX_EPISODE_NUMBERS = 2**26  # T times X: 256 MiB of float32, and as much again while they are written
MAX_EPISODES = 2_000_000  # their names are kept: 0.2 GiB where they are short
_LARGEST_TIMESTEP = 2**53  # beyond it, numbers of CSV no longer rise by 1
_KINDS = frozenset({bool, int, float})


@dataclass(frozen=True)
class Episode:
    """One episode as it is recorded."""

    observations: dict[str, NDArray[np.float32]]  # [T+1, n] of each part ("" where flat); the last row stands twice
    actions: NDArray[np.float32] | NDArray[np.int64]  # [T, A]; whole [T] where the action is a choice
    rewards: NDArray[np.float32]  # [T]
    terminated: bool  # at its last timestep
    truncated: bool


def cut(rows: Iterable[Row], columns: ColumnMap) -> Iterator[Episode]:
    """Episodes, each once the row after it is read. Raises SourceError naming the row and the column."""
    form = _Form(columns)
    names: set[str] = set()
    growing = None
    for where, cells in rows:
        finished = None
        try:
            step = form.step(cells)
            if growing is None or step.episode != growing.name:
                _check_new(step.episode, names)
                names.add(step.episode)
                finished, growing = growing, _Growing(step.episode, columns)
            growing.add(where, step)
        except SourceError:
            raise
        except ValueError as error:
            raise SourceError(f"{where}: {error}") from error
        if finished is not None:
            yield finished.episode()
    if growing is not None:
        yield growing.episode()


class _Step(NamedTuple):
    """A row that was checked by itself."""

    episode: str
    timestep: int | None
    terminated: bool
    truncated: bool
    numbers_X: NDArray[np.float32]


class _Form:
    """What every row must be."""

    def __init__(self, columns: ColumnMap) -> None:
        self._columns = columns
        self._at = {name: i for i, name in enumerate(columns.names)}
        self._numbers = [(self._at[column.column], column) for column in columns.numbers]
        n_actions = sum(column.width for column in columns.actions)
        n_observed = len(columns.labels) - n_actions - 1
        low_A, high_A = columns.action_range
        free = np.full(n_observed, LARGEST)
        self._low_X = np.concatenate([-free, low_A, [-LARGEST]])
        self._high_X = np.concatenate([free, high_A, [LARGEST]])

    def step(self, cells: Sequence[object]) -> _Step:
        """Raises ValueError naming the column."""
        terminated = self._flag(self._columns.terminated, cells)
        truncated = self._flag(self._columns.truncated, cells)
        return _Step(self._episode(cells), self._timestep(cells), terminated, truncated, self._row(cells))

    def _episode(self, cells: Sequence[object]) -> str:
        name = cells[self._at[self._columns.episode]]
        if type(name) not in (str, int) or not 1 <= len(str(name)) <= MAX_NAME:
            raise _wrong(self._columns.episode, name, f"text of 1 to {MAX_NAME} characters or a whole number")
        return str(name)

    def _timestep(self, cells: Sequence[object]) -> int | None:
        if self._columns.timestep is None:
            return None
        step = cells[self._at[self._columns.timestep]]
        if type(step) not in (int, float) or not abs(step) <= _LARGEST_TIMESTEP or step != int(step):
            raise _wrong(self._columns.timestep, step, "a whole number of at most 2^53")
        return int(step)

    def _flag(self, column: str | None, cells: Sequence[object]) -> bool:
        if column is None:
            return False
        flag = cells[self._at[column]]
        if type(flag) not in _KINDS or flag not in (0, 1):
            raise _wrong(column, flag, "true, false, 1 or 0")
        return bool(flag)

    def _row(self, cells: Sequence[object]) -> NDArray[np.float32]:
        values: list[object] = []
        for at, column in self._numbers:
            if column.size is None:
                values.append(cells[at])
                continue
            part = cells[at]
            if not isinstance(part, list) or len(part) != column.size:
                raise _wrong(column.column, part, f"a list of {column.size} numbers")
            values.extend(part)
        try:
            row_X = np.frombuffer(array("d", values))  # refuses None and text, where numpy reads numbers out of them
        except (TypeError, OverflowError):
            raise self._wrong_number(values) from None
        if not ((row_X >= self._low_X) & (row_X <= self._high_X)).all():
            raise self._wrong_number(values)
        if self._columns.choices is not None and not row_X[-2].is_integer():
            raise self._wrong_choice(values[-2])
        return row_X.astype(np.float32)

    def _wrong_number(self, values: list) -> ValueError:
        lows, highs = self._low_X.tolist(), self._high_X.tolist()
        ranges = zip(values, lows, highs, strict=True)
        i = next(i for i, (x, low, high) in enumerate(ranges) if type(x) not in _KINDS or not low <= x <= high)
        if self._columns.choices is not None and i == len(values) - 2:
            return self._wrong_choice(values[i])
        expected = "a finite number that float32 holds"
        if (lows[i], highs[i]) != (-LARGEST, LARGEST):
            expected = f"a number from {lows[i]:g} to {highs[i]:g}, as the column map says"
        return _wrong(self._columns.labels[i], values[i], expected)

    def _wrong_choice(self, value: object) -> ValueError:
        expected = f"a whole number from 0 to {self._columns.choices - 1}, as the column map says"
        return _wrong(self._columns.labels[-2], value, expected)


class _Growing:
    """The episode whose rows are being read."""

    def __init__(self, name: str, columns: ColumnMap) -> None:
        self.name = name
        self._columns = columns
        self._numbers = array("f")  # T * X
        self._where = ""
        self._last: _Step | None = None

    def add(self, where: str, step: _Step) -> None:
        """Raises ValueError for a row that cannot follow, SourceError for one that cannot be followed."""
        last = self._last
        if last is not None:
            for flag in ("terminated", "truncated"):
                if getattr(last, flag):
                    wrong = _wrong(getattr(self._columns, flag), True, "false before the last row of an episode")
                    raise SourceError(f"{self._where}: {wrong}")
            if last.timestep is not None and step.timestep != last.timestep + 1:
                raise _wrong(self._columns.timestep, step.timestep, f"{last.timestep + 1}: it rises by 1 in an episode")
        if len(self._numbers) + len(step.numbers_X) > MAX_EPISODE_NUMBERS:
            steps = MAX_EPISODE_NUMBERS // len(step.numbers_X)
            raise ValueError(f"episode {shown(self.name)} is longer than {steps} rows, the most of this many numbers")
        self._numbers.frombytes(step.numbers_X.tobytes())
        self._where, self._last = where, step

    def episode(self) -> Episode:
        """What was read. Who neither terminated nor truncated an episode stopped recording it: that truncates."""
        numbers_TX = np.frombuffer(self._numbers, np.float32).reshape(-1, len(self._columns.labels))
        observations, begin = {}, 0
        for key, part in self._columns.observed.items():
            end = begin + sum(column.width for column in part)
            observations[key] = np.concatenate([numbers_TX[:, begin:end], numbers_TX[-1:, begin:end]])
            begin = end
        terminated, truncated = self._last.terminated, self._last.truncated
        actions, rewards_T = numbers_TX[:, begin:-1], numbers_TX[:, -1]
        if self._columns.choices is not None:
            actions = actions[:, 0].astype(np.int64)
        return Episode(observations, actions, rewards_T, terminated, truncated or not terminated)


def _check_new(name: str, names: set[str]) -> None:
    if name in names:
        raise ValueError(f"episode {shown(name)} comes back, expected its rows to stand together")
    if len(names) == MAX_EPISODES:
        raise ValueError(f"episode {shown(name)} is one more than {MAX_EPISODES}, the most that there may be")


def _wrong(column: str, value: object, expected: str) -> ValueError:
    stands = "is empty" if value is None or value == "" else f"holds {shown(value)}"
    return ValueError(f"column {column!r} {stands}, expected {expected}")
