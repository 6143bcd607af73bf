"""A first feature map of a dataset, to be edited: `python -m training.draft_map DATASET map.json --cost-us 1`.

Every number of the observation becomes a feature of its own. With `--copies` each of them comes several times, as
`exact:20:0 low:5:0.1`: the group's name, the cost in µs, and the standard deviation of the noise that is added as a
multiple of the number's own over the recorded episodes.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from rich.console import Console

from training.command import command
from training.datasets import Dataset, observation_sizes, open_dataset
from training.feature_map import FeatureMap, MappedFeature

__all__ = ["Copy", "DraftConfig", "draft_map"]

_EPISODES = 50  # enough for a deviation


class Copy(NamedTuple):
    """One copy of every number."""

    group: str
    cost_us: float
    noise: float  # multiple of the number's own deviation

    @classmethod
    def parse(cls, text: str) -> Copy:
        """`low:5:0.1`. Raises ValueError."""
        try:
            group, cost_us, noise = text.split(":")
            return cls(group, float(cost_us), float(noise))
        except ValueError as error:
            raise ValueError(f"copy {text!r} is not group:cost_us:noise, such as low:5:0.1") from error


@dataclass(frozen=True)
class DraftConfig:
    """Which dataset, where to, and what the numbers cost."""

    dataset: tyro.conf.Positional[Path]
    out: tyro.conf.Positional[Path]
    cost_us: float = 1.0  # of every number
    names: tuple[str, ...] = ()  # of the numbers, in order (none: part and index)
    copies: tuple[str, ...] = ()  # group:cost_us:noise, instead of cost_us

    def __post_init__(self) -> None:
        if self.out.exists():
            raise ValueError(f"{self.out} exists: a map that was edited is not overwritten")
        if not self.out.parent.is_dir():
            raise ValueError(f"{self.out.parent} is not a folder, expected the one that {self.out.name} goes into")
        for text in self.copies:
            Copy.parse(text)


def draft_map(config: DraftConfig) -> FeatureMap:
    """One feature a number and copy. Raises ValueError, TracesError too, for what training would refuse."""
    sizes = observation_sizes(config.dataset)
    copies = [Copy.parse(text) for text in config.copies] or [Copy("", config.cost_us, 0.0)]
    numbers = [(key, i) for key, size in sizes.items() for i in range(size)]
    names = config.names or tuple(f"{_as_name(key)}_{i}" for key, i in numbers)
    if len(names) != len(numbers):
        raise ValueError(f"names are {len(names)}, the observation has {len(numbers)} numbers")
    plain = FeatureMap(
        tuple(
            MappedFeature(name, numbers=(i,), key=key, cost_us=1.0)
            for name, (key, i) in zip(names, numbers, strict=True)
        )
    )
    if all(copy.noise == 0.0 for copy in copies):
        deviations = np.zeros(len(numbers))
    else:
        deviations = _deviations(open_dataset(config.dataset, plain))
    features = []
    for copy, (name, (key, i), deviation) in itertools.product(copies, zip(names, numbers, deviations, strict=True)):
        full = f"{name}_{copy.group}" if len(copies) > 1 else name
        noise = float(f"{copy.noise * deviation:.4g}")
        features.append(MappedFeature(full, (i,), key, copy.cost_us, noise, copy.group))
    drafted = FeatureMap(tuple(features))
    drafted.table(sizes)
    return drafted


def _as_name(key: str) -> str:
    """A part's key as a feature may be called."""
    name = re.sub(r"[^a-z0-9_]", "_", key.lower())
    return name if name[:1].isalpha() else f"number{name}"


def _deviations(dataset: Dataset) -> np.ndarray:
    """Standard deviation of each number, as a plain map gives them."""
    episodes = range(min(len(dataset), _EPISODES))
    return np.concatenate([dataset.episode(i).costly_TD for i in episodes]).std(axis=0)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    with command():
        config = tyro.cli(DraftConfig, args=arguments, description=__doc__)
        drafted = draft_map(config)
        drafted.write(config.out)
    Console().print(f"{config.out}: {len(drafted.features)} features; edit their names, costs and groups")


if __name__ == "__main__":
    main()
