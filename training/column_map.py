"""Which columns of a log hold what: the column map that an import is given, a JSON file.

    {"episode": "match", "timestep": "tick", "observation": ["health", {"column": "position", "size": 3}],
     "action": [{"column": "turn", "low": -1, "high": 1}, "forward"], "reward": "score", "terminated": "died"}

`observations` in place of `observation` names parts: {"body": ["health"], "rays": [{"column": "rays", "size": 96}]}.
A column with a `size` holds a list of so many numbers in every row. An action that is one of a few choices is
`"action": [{"column": "key", "choices": 3}]`. This module knows nothing about rows and files of rows. Shape letters:
A action numbers, X numbers of a timestep.
"""

from __future__ import annotations

import codecs
import re
from collections import Counter
from functools import cached_property
from pathlib import Path

import gymnasium
import msgspec
import numpy as np
from gymnasium.envs.registration import parse_env_id
from numpy.typing import NDArray

__all__ = ["LARGEST", "MAX_COLUMNS", "MAX_NAME", "MAX_NUMBERS", "ActionColumn", "Column", "ColumnMap"]

MAX_COLUMNS = 16_384  # of a source, and of a map: a column a number, where a timestep has the most numbers
MAX_NAME = 256  # characters, of a column or of an episode: names of all episodes are kept, to notice one that returns
MAX_CHOICES = 16_384  # of an action; training needs an output of the network for each
MAX_NUMBERS = 16_384  # of a timestep: the shipped games have 600, and a row of text must fit a line
LARGEST = float(np.finfo(np.float32).max)  # what is recorded is float32
_MAX_MAP_BYTES = 2**22  # MAX_COLUMNS names of MAX_NAME characters
_KEY = re.compile(r"^[A-Za-z][A-Za-z0-9_]{0,63}$")  # of a part of the observation; HDF5 gives "/" and "." a meaning


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A column of numbers; with a `size`, a column of lists of so many numbers."""

    column: str
    size: int | None = None

    def __post_init__(self) -> None:
        _check_name("column", self.column)
        if self.size is not None and not 1 <= self.size <= MAX_NUMBERS:
            raise ValueError(f"column {self.column!r} has size {self.size}, expected 1 to {MAX_NUMBERS}")

    @property
    def width(self) -> int:
        """How many numbers it gives a timestep."""
        return 1 if self.size is None else self.size

    @property
    def labels(self) -> list[str]:
        """A name for each of its numbers, as errors and tables say it: `turn`, or `position[0]` to `position[2]`."""
        return [self.column] if self.size is None else [f"{self.column}[{i}]" for i in range(self.size)]


class ActionColumn(Column, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A column of the action. `low` and `high` are the range of its numbers; None takes what the log has. With
    `choices`, it holds which of so many was taken: a whole number from 0."""

    low: float | None = None
    high: float | None = None
    choices: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, bound in (("low", self.low), ("high", self.high)):
            if bound is not None and not -LARGEST <= bound <= LARGEST:
                raise ValueError(f"action {self.column!r} has {name} {bound}, expected a finite float32")
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"action {self.column!r} has range [{self.low}, {self.high}], expected increasing")
        if self.choices is None:
            return
        if not 2 <= self.choices <= MAX_CHOICES:
            raise ValueError(f"action {self.column!r} has {self.choices} choices, expected 2 to {MAX_CHOICES}")
        if (self.size, self.low, self.high) != (None, None, None):
            raise ValueError(f"action {self.column!r} has choices, expected neither size nor low nor high beside them")

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest number that a row may hold; float32's own where none is declared."""
        if self.choices is not None:
            return 0.0, self.choices - 1.0
        return -LARGEST if self.low is None else self.low, LARGEST if self.high is None else self.high


class ColumnMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True, dict=True):
    """The map as it is written; a plain name stands for a column without size or range. Raises ValueError."""

    episode: str  # column whose value marks the episode: text or a whole number
    action: tuple[str | ActionColumn, ...]
    reward: str
    observation: tuple[str | Column, ...] = ()
    observations: dict[str, tuple[str | Column, ...]] = {}  # by part
    timestep: str | None = None  # column that rises by 1 within an episode
    terminated: str | None = None  # columns of flags, true at an episode's last row only
    truncated: str | None = None
    environment: str | None = None  # gymnasium id, written down and never made

    def __post_init__(self) -> None:
        for name in ("episode", "reward", "timestep", "terminated", "truncated"):
            if getattr(self, name) is not None:
                _check_name(name, getattr(self, name))
        if bool(self.observation) == bool(self.observations):
            raise ValueError("expected either `observation` or `observations`, with one column or more")
        for key in self.observations:
            if not _KEY.match(key):
                raise ValueError(f"observations has key {key!r}, expected a match of {_KEY.pattern}")
        for key, part in self.observed.items():
            _check_list(f"observations.{key}" if key else "observation", part)
        _check_list("action", self.actions)
        if len(self.actions) > 1 and any(column.choices is not None for column in self.actions):
            raise ValueError("action has choices in one of several columns, expected an action of one column")
        _check_sizes(self.numbers)
        if len(self.names) > MAX_COLUMNS or len(self.labels) > MAX_NUMBERS:
            raise ValueError(
                f"{len(self.names)} columns with {len(self.labels)} numbers a timestep, expected at most "
                f"{MAX_COLUMNS} and {MAX_NUMBERS}"
            )
        if self.environment is not None:
            _check_environment(self.environment)

    @classmethod
    def read(cls, path: Path) -> ColumnMap:
        """Read a file. Raises ValueError naming it and the field, OSError."""
        with path.open("rb") as file:
            text = file.read(_MAX_MAP_BYTES + 1)
        if len(text) > _MAX_MAP_BYTES:
            raise ValueError(f"{path} is longer than {_MAX_MAP_BYTES} bytes, the most that a column map may have")
        try:
            return msgspec.json.decode(text.removeprefix(codecs.BOM_UTF8), type=cls)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: {error}") from error

    @cached_property
    def observed(self) -> dict[str, tuple[Column, ...]]:
        """Columns of each part of the observation; a flat observation is one part, whose key is empty."""
        parts = self.observations or {"": self.observation}
        return {key: _columns(part, Column) for key, part in parts.items()}

    @cached_property
    def actions(self) -> tuple[ActionColumn, ...]:
        """Columns of the action."""
        return _columns(self.action, ActionColumn)

    @cached_property
    def numbers(self) -> tuple[Column, ...]:
        """Columns of all numbers of a timestep, in the order in which they are kept: observation, action, reward."""
        return (*(column for part in self.observed.values() for column in part), *self.actions, Column(self.reward))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """A name for each number of a timestep, [X]."""
        return tuple(label for column in self.numbers for label in column.labels)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Every column that is read, once."""
        single = (self.episode, self.timestep, self.terminated, self.truncated)
        return tuple(dict.fromkeys(name for name in (*single, *(c.column for c in self.numbers)) if name is not None))

    @cached_property
    def choices(self) -> int | None:
        """How many the action is one of; None where it is numbers."""
        return self.actions[0].choices

    @cached_property
    def action_range(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest value of each action number, each shape [A]; float32's own where none is declared."""
        ranges = np.array([column.bounds for column in self.actions for _ in range(column.width)])
        return ranges[:, 0], ranges[:, 1]


def _columns(part: tuple[str | Column, ...], kind: type) -> tuple[Column, ...]:
    return tuple(kind(column) if isinstance(column, str) else column for column in part)


def _check_name(field: str, name: str) -> None:
    if not 1 <= len(name) <= MAX_NAME:
        raise ValueError(f"{field} is a name of {len(name)} characters, expected 1 to {MAX_NAME}")


def _check_list(field: str, columns: tuple[Column, ...]) -> None:
    if not columns:
        raise ValueError(f"{field} is an empty list, expected one column or more")
    name, count = Counter(column.column for column in columns).most_common(1)[0]
    if count > 1:
        raise ValueError(f"{field} names column {name!r} {count} times, expected once")


def _check_sizes(columns: tuple[Column, ...]) -> None:
    sizes: dict[str, int | None] = {}
    for column in columns:
        if sizes.setdefault(column.column, column.size) != column.size:
            raise ValueError(
                f"column {column.column!r} has size {column.size} and {sizes[column.column]}, expected one"
            )


def _check_environment(name: str) -> None:
    try:
        parse_env_id(name)
    except gymnasium.error.Error as error:
        raise ValueError(f"environment is {name[:80]!r}, expected a gymnasium id such as Game-v0") from error
