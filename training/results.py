"""A folder of results becomes measurements: which run was measured how, and what came out.

RESULTS/<run>/ holds config.json, metrics.jsonl, evaluations/<label>.json and perhaps heat_map.npz. This module knows
nothing about tables, figures or the paper.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from training.config import DATASET_NAME, TrainConfig

__all__ = ["BASE", "NO_RAYS", "Constraint", "Kind", "Measurement", "Results", "Run", "Series", "Setting"]

Kind = Literal["soft", "hard"]
Constraint = float | str  # C, or one of the two below
BASE = "base"  # every feature, always
NO_RAYS = "none"  # no costly feature, ever

_LABEL = re.compile(r"(soft|hard)-([0-9.e+-]+)\.json")


class Setting(NamedTuple):
    """What is played: a map or environment, the players that the traces are of, and what can be known of it."""

    map: str
    dataset: str
    features: str = ""  # which feature map, where an environment has several

    def __str__(self) -> str:
        return " ".join(part for part in self if part)

    @classmethod
    def of(cls, config: TrainConfig) -> Setting:
        """`hard-expert-v0` is the map hard and the dataset expert; another name is a dataset without a map.
        `hard-noisy.json` are the features noisy of the map hard."""
        match = DATASET_NAME.fullmatch(config.dataset_name)
        if match is None:
            return cls("", config.dataset_name)
        return cls(match["map"], match["quality"], config.feature_set)


class Series(NamedTuple):
    """One line of a figure, one column of a table: a method, and how it was trained where that is not as printed."""

    method: str  # BDT, RCBC, BC, IQL, BDT random, BDT conditioned, ...
    variant: str = ""

    def __str__(self) -> str:
        return f"{self.method} ({self.variant})" if self.variant else self.method

    @classmethod
    def of(cls, config: TrainConfig) -> Series:
        """The series that a run belongs to. Runs whose queries are forced count to their method's fixed-C series."""
        method = config.method.upper()
        if config.acquisition == "random":
            method += " random"
        elif config.acquisition == "learned" and config.budgets:
            method += " conditioned"
        if config.acquisition != "learned":
            return cls(method)
        parts: list[str] = [config.control] if config.control != "algorithm-1" else []
        parts += [f"{config.allocation} allocation"] if config.allocation != "none" else []
        return cls(method, ", ".join(parts))


@dataclass(frozen=True)
class Run:
    """One trained network."""

    folder: Path
    config: TrainConfig

    @property
    def series(self) -> Series:
        return Series.of(self.config)

    @property
    def setting(self) -> Setting:
        return Setting.of(self.config)


class _Numbers(msgspec.Struct, frozen=True):
    """What is read of an evaluation (training/evaluate.py)."""

    episodes: int
    return_mean: float
    soft_cost_pct: float
    hard_cost_pct: float
    violations: int
    trained_budget: float | None
    target_cost: float | None
    acquired_pct: dict[str, float] = {}  # none before groups were counted


@dataclass(frozen=True)
class Measurement:
    """One evaluation of one run. `soft` capped nothing; `hard` let all bots of a frame share C of their full cost."""

    run: Run
    kind: Kind
    constraint: Constraint
    numbers: _Numbers

    @property
    def seed(self) -> int:
        return self.run.config.seed

    @property
    def value(self) -> float:
        """The mean return, normalised where the run has reference returns: they are 0 and 100."""
        references = self.run.config.reference_returns
        if references is None:
            return self.numbers.return_mean
        return 100.0 * (self.numbers.return_mean - references[0]) / (references[1] - references[0])

    @property
    def is_normalised(self) -> bool:
        """Whether `value` is on the scale of reference returns."""
        return self.run.config.reference_returns is not None

    @property
    def spend_pct(self) -> float:
        """What counts as spent: what was asked for, or what a hard budget allowed of it."""
        return self.numbers.soft_cost_pct if self.kind == "soft" else self.numbers.hard_cost_pct


@dataclass(frozen=True)
class Results:
    """All runs and all evaluations of a folder; `skipped` are files whose label says nothing known."""

    runs: list[Run]
    measurements: list[Measurement]
    skipped: list[Path]

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Read every run folder in `folder`, or the one that it is itself. Raises ValueError naming the file, also for
        two runs of one cell."""
        own = folder / "config.json"
        configs = [own] if own.exists() else sorted(folder.glob("*/config.json"))
        if not configs:
            raise ValueError(f"{folder} holds no runs, expected <run>/config.json")
        runs = [Run(path.parent, TrainConfig.read(path)) for path in configs]
        measurements, skipped = [], []
        for run in runs:
            for path in sorted((run.folder / "evaluations").glob("*.json")):
                if match := _LABEL.fullmatch(path.name):
                    measurements.append(_measurement(run, path, "soft" if match[1] == "soft" else "hard", match[2]))
                else:
                    skipped.append(path)
        _check_apart(measurements)
        return cls(runs, measurements, skipped)

    @property
    def settings(self) -> list[Setting]:
        """Maps and datasets that were trained on, in order."""
        return sorted({run.setting for run in self.runs})

    def of(self, setting: Setting, kind: Kind | None = None) -> list[Measurement]:
        """The measurements of a map and dataset."""
        return [one for one in self.measurements if one.run.setting == setting and kind in (None, one.kind)]


def _measurement(run: Run, path: Path, kind: Kind, label: str) -> Measurement:
    try:
        numbers = msgspec.json.decode(path.read_bytes(), type=_Numbers)
        cost = float(label)
    except (ValueError, msgspec.DecodeError) as error:
        raise ValueError(f"{path}: {error}") from error
    forced = {"all": BASE, "none": NO_RAYS}.get(run.config.acquisition)
    if forced is not None:
        return Measurement(run, kind, forced, numbers)
    asked = numbers.trained_budget if numbers.target_cost is None else numbers.target_cost
    if asked is None or f"{asked:g}" != f"{cost:g}":
        raise ValueError(f"{path} was asked for C = {asked}, its name says {cost:g}")
    return Measurement(run, kind, cost, numbers)


def _check_apart(measurements: list[Measurement]) -> None:
    """Two networks of one series, C and seed are no two seeds of it: they differ in a setting that no column shows."""
    seen: dict[tuple[object, ...], Run] = {}
    for one in measurements:
        key = (one.run.series, one.run.setting, one.kind, one.constraint, one.seed)
        other = seen.setdefault(key, one.run)
        if other is not one.run:
            ours, theirs = asdict(one.run.config), asdict(other.config)
            differ = sorted(name for name in ours if ours[name] != theirs[name] and name not in ("out", "name"))
            raise ValueError(
                f"{other.folder} and {one.run.folder} are both {one.run.series} with seed {one.seed} at C = "
                f"{one.constraint}, and differ in {differ}: report them apart"
            )
