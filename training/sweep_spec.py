"""What a sweep is: a JSON file of settings, read into the runs that it stands for. No files but that one are touched.

    {"out": "runs/navigation", "base": {settings}, "grid": [{block}, ...],
     "evaluate": {"episodes": 256, "costs": [0.5, 0.1, 0.01], "heat_map": 0.1}}

A block gives each setting of TrainConfig one value or a list of values, and stands for every combination of them, the
last setting varying fastest. A setting that is itself a list (bins, budgets, sampled) varies as a list of lists.
Settings that vary together share a key: {"dataset,environment": [["a", "game.env:A-v0"], ["b", "game.env:B-v0"]]}.
A block may say `evaluate` for itself. A run without an environment is trained and exported only.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import msgspec

from training.config import TrainConfig
from training.evaluate import EvaluateConfig
from training.sweep_run import Run

__all__ = ["EvaluateSpec", "SweepSpec"]

_SETTINGS = frozenset(field.name for field in fields(TrainConfig))
_LISTS = frozenset(
    name
    for name, kind in get_type_hints(TrainConfig).items()
    if tuple in (get_origin(kind), *map(get_origin, get_args(kind)))  # or None
)
_OWN = frozenset({"out", "name"})  # the sweep gives every run its folder and its name
_NAMED = frozenset(
    {"feature_map", "more_datasets", "method", "acquisition", "dataset", "budget", "budgets", "control", "seed"}
)
_LONGEST_NAME = 64  # of a bundle (bot_runtime/manifest.py)
_SHARING_BOTS = 32  # that play at once where they share a frame's budget


class EvaluateSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How every bundle is evaluated."""

    episodes: int = 256
    costs: tuple[float, ...] = (0.5, 0.1, 0.01)  # C of a budget-conditioned network; others have their own
    kinds: tuple[Literal["soft", "hard"], ...] = ("soft", "hard")  # without a cap, and with what a frame shares capped
    heat_map: float | None = None  # C of the evaluation without caps that draws one; None: none does

    def __post_init__(self) -> None:
        labels = [f"{cost:g}" for cost in self.costs]
        if not labels or len(set(labels)) < len(labels):
            raise ValueError(f"costs is {list(self.costs)}, expected one or more, all different")
        if not self.kinds or len(set(self.kinds)) < len(self.kinds):
            raise ValueError(f"kinds is {list(self.kinds)}, expected one or both, each once")


class SweepSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sweep as it is written. Raises ValueError (ValidationError is one) for what cannot be."""

    out: str  # folder of the runs, one folder a run
    grid: list[dict[str, object]]
    base: dict[str, object] = {}  # settings of every run
    evaluate: dict[str, object] = {}

    @classmethod
    def read(cls, path: Path) -> SweepSpec:
        """Read a file; every error names it."""
        with _naming(str(path)):
            return msgspec.json.decode(path.read_bytes(), type=cls)

    def runs(self) -> list[Run]:
        """Every run, blocks in order. Raises ValueError naming the block, for two runs of one name too."""
        runs: dict[str, Run] = {}
        with _naming("base"):
            _check_names(self.base)
        for number, block in enumerate(self.grid):
            with _naming(f"grid[{number}]"):
                for run in self._block(block):
                    if run.name in runs:
                        raise ValueError(_clash(runs[run.name], run))
                    runs[run.name] = run
        if not runs:
            raise ValueError("grid is empty, expected one or more blocks")
        return list(runs.values())

    def _block(self, block: dict[str, object]) -> Iterator[Run]:
        swept = {key: value for key, value in block.items() if key != "evaluate"}
        _check_names([name for key in swept for name in _split(key)])
        asked = msgspec.convert({"evaluate": block.get("evaluate", {})}, dict[str, dict[str, object]])["evaluate"]
        evaluate = msgspec.convert({**self.evaluate, **asked}, EvaluateSpec)
        tags = [_split(key)[0] for key, value in swept.items() if _varies(key, value)]
        for point in itertools.product(*(_choices(key, value) for key, value in swept.items())):
            settings = dict(self.base)
            for part in point:
                settings |= part
            yield self._run(settings, [tag for tag in tags if tag not in _NAMED], evaluate)

    def _run(self, settings: dict[str, object], tags: list[str], evaluate: EvaluateSpec) -> Run:
        # The name follows from the other settings, which are checked before it is made.
        config = _convert({**settings, "out": self.out, "name": "unnamed"})
        name = _name(config, tags)
        if len(name) > _LONGEST_NAME:
            raise ValueError(f"run name {name} has {len(name)} characters, expected at most {_LONGEST_NAME}")
        config = _convert({**settings, "out": str(Path(self.out) / name), "name": name})
        return Run(config, _evaluations(config, evaluate))


def _convert(settings: dict[str, object]) -> TrainConfig:
    return msgspec.convert(settings, TrainConfig, dec_hook=lambda kind, value: kind(value))


def _split(key: str) -> list[str]:
    return [name.strip() for name in key.split(",")]


@contextmanager
def _naming(where: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _check_names(names: Collection[str]) -> None:
    if own := _OWN & set(names):
        raise ValueError(f"{sorted(own)} is what the sweep gives to every run itself")
    if unknown := set(names) - _SETTINGS:
        raise ValueError(f"unknown settings {sorted(unknown)}, expected those of training/config.py")
    if len(set(names)) < len(names):
        raise ValueError(f"a setting is given twice in {sorted(names)}")


def _varies(key: str, value: object) -> bool:
    """Whether this is a list of values; a list of numbers is one value of a setting that is a list."""
    if not isinstance(value, list):
        return False
    return "," in key or key not in _LISTS or any(isinstance(part, list) for part in value)


def _choices(key: str, value: object) -> list[dict[str, object]]:
    """What a key of a block stands for: settings that hold together."""
    names = _split(key)
    values = value if isinstance(value, list) and _varies(key, value) else [value]
    if not values:
        raise ValueError(f"{key} is an empty list, expected one or more values")
    if len(names) == 1:
        return [{key: each} for each in values]
    for row in values:
        if not isinstance(row, list) or len(row) != len(names):
            raise ValueError(f"{key} has {row!r}, expected lists of {len(names)} values")
    return [dict(zip(names, row, strict=True)) for row in values]


def _name(config: TrainConfig, tags: list[str]) -> str:
    """Fixed parts, so that a sweep that grows keeps the names of its runs; then what else varies within its block."""
    parts = [config.method, config.acquisition, config.dataset_name]
    if config.budgets:
        parts.append("conditioned")
    elif config.acquisition not in ("all", "none"):
        parts.append(f"c{config.budget:g}")
    if config.control != "algorithm-1":
        parts.append(config.control)
    parts += [config.feature_set] if config.feature_set else []
    for tag in tags:
        value = getattr(config, tag)
        text = "_".join(map(str, value)) if isinstance(value, tuple) else str(value)
        parts.append(text if isinstance(value, str) else tag + text)  # a word says enough
    return re.sub(r"[^a-z0-9_-]+", "_", "-".join([*parts, f"s{config.seed}"]).lower())


def _clash(earlier: Run, run: Run) -> str:
    theirs, ours = asdict(earlier.config), asdict(run.config)
    differing = sorted(name for name in ours if ours[name] != theirs[name])
    if not differing:
        return f"run {run.name} is asked for twice"
    return f"two runs would be {run.name}, though they differ in {differing}: a block that lists values names them"


def _evaluations(config: TrainConfig, asked: EvaluateSpec) -> dict[str, EvaluateConfig]:
    """By label: `soft-<C>` asks for C and caps nothing, `hard-<C>` also caps what all bots of a frame share."""
    if not config.environment:
        return {}
    forced = {"all": 1.0, "none": 0.0}.get(config.acquisition)
    conditioned = forced is None and bool(config.budgets)
    costs = asked.costs if conditioned else (config.budget if forced is None else forced,)
    evaluations = {}
    for cost, kind in itertools.product(costs, ("soft",) if forced is not None else asked.kinds):
        label = f"{kind}-{cost:g}"
        evaluations[label] = EvaluateConfig(
            bundle=config.out / "bundle",
            environment=config.environment,
            episodes=asked.episodes,
            target_cost=cost if conditioned else None,
            budget=1.0,
            frame_budget=cost if kind == "hard" else None,
            bots=_SHARING_BOTS,
            workers=1,  # as many as the run has threads, once it runs
            out=config.out / "evaluations" / f"{label}.json",
            heat_map=config.out / "heat_map.npz" if kind == "soft" and cost == asked.heat_map else None,
        )
    return evaluations
