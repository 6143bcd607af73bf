"""A feature map: which numbers of an environment's own observation form a feature, which are free, what each costs.

With one, any gymnasium environment whose observation is flat or a dict of flat parts can be trained on and played, by
configuration alone. The map is a JSON file:

    {"features": [{"name": "speed", "numbers": [8, 9]}, {"name": "lidar", "key": "rays", "cost_us": 12.5},
                  {"name": "lidar_rough", "key": "rays", "cost_us": 2.0, "noise": 0.1, "group": "low noise"}]}

A feature may be a noisy copy of another: the same numbers with Gaussian noise, drawn anew at every timestep. This
module knows nothing about datasets, networks or environments.
"""

from __future__ import annotations

import codecs
import json
import math
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.features import Feature, FeatureTable

__all__ = ["FEATURE_MAP", "FeatureMap", "MappedFeature", "Parts", "parts_of"]

FEATURE_MAP = "feature_map.json"  # name of the file in a bundle that was trained with one

Parts = Mapping[str, NDArray[np.floating]]
"""The parts of observations, each [T, n]; a flat observation has one part, named ""."""


def parts_of(observations: object, timesteps: int) -> Parts:
    """The first `timesteps` of recorded observations, every part flat; parts that are no numbers are left out."""
    parts = observations if isinstance(observations, Mapping) else {"": observations}
    arrays = {str(key): np.asarray(part) for key, part in parts.items() if not isinstance(part, Mapping | tuple)}
    return {key: _rows(array[:timesteps]) for key, array in arrays.items() if array.dtype.kind in "fiub"}


def _rows(part: NDArray[np.floating]) -> NDArray[np.floating]:
    return part.reshape(len(part), math.prod(part.shape[1:]))


class MappedFeature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One feature: numbers of the observation, in this order."""

    name: str
    numbers: tuple[int, ...] | None = None  # indices into the observation (or its part `key`); None: all of them
    key: str = ""  # part of a dict observation
    cost_us: float = 0.0  # 0: free
    noise: float = 0.0  # standard deviation of what is added, in the numbers' own units
    group: str = ""  # kind that an evaluation reports together, such as "low noise"
    low: float = -1e6  # what lies outside is refused at run time
    high: float = 1e6

    def __post_init__(self) -> None:
        if self.numbers is not None and (not self.numbers or min(self.numbers) < 0):
            raise ValueError(
                f"feature {self.name} has numbers {self.numbers}, expected indices from 0, or null for all"
            )
        if not 0.0 <= self.noise < np.inf:
            raise ValueError(f"feature {self.name} has noise {self.noise}, expected a finite standard deviation")


class FeatureMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """Every feature of a policy, free ones and costly ones. Raises ValueError for what `protocol.features` refuses."""

    features: tuple[MappedFeature, ...]

    @classmethod
    def read(cls, path: Path) -> FeatureMap:
        """Read a file; every error names it."""
        try:
            return msgspec.json.decode(path.read_bytes().removeprefix(codecs.BOM_UTF8), type=cls)
        except (OSError, ValueError) as error:
            raise ValueError(f"{path}: {error}") from error

    def write(self, path: Path) -> None:
        """Write what `read` reads, a feature a line; what is as by default is left out."""
        defaults = {field.name: field.default for field in msgspec.structs.fields(MappedFeature)}
        lines = []
        for one in self.features:
            told = {name: value for name, value in msgspec.structs.asdict(one).items() if value != defaults[name]}
            lines.append(json.dumps(told))
        path.write_text('{"features": [\n ' + ",\n ".join(lines) + "\n]}\n", encoding="utf-8")

    def table(self, sizes: Mapping[str, int]) -> FeatureTable:
        """The features as both ends of the wire know them. `sizes`: how many numbers each part of the observation has;
        a flat one is the part "". Raises ValueError naming a feature that is not in it."""
        return FeatureTable(
            tuple(
                Feature(one.name, self._size(one, sizes), one.cost_us, low=one.low, high=one.high)
                for one in self.features
            )
        )

    @cached_property
    def groups(self) -> tuple[str, ...]:
        """Group of each costly feature, [M]."""
        return tuple(one.group for one in self.features if one.cost_us > 0.0)

    def split(self, parts: Parts, chance: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Free numbers [T, F] and costly numbers [T, D]; `chance` gives the noise."""
        free = [self._numbers(one, parts, chance) for one in self.features if one.cost_us == 0.0]
        costly = [self._numbers(one, parts, chance) for one in self.features if one.cost_us > 0.0]
        none = np.empty((len((free or costly)[0]), 0), dtype=np.float32)
        return np.concatenate([none, *free], axis=1), np.concatenate([none, *costly], axis=1)

    @staticmethod
    def _size(one: MappedFeature, sizes: Mapping[str, int]) -> int:
        if one.key not in sizes:
            expected = f"one of {sorted(sizes)}" if sizes.keys() != {""} else "none: the observation is flat"
            raise ValueError(f"feature {one.name} has key {one.key!r}, expected {expected}")
        size = sizes[one.key]
        if one.numbers is None:
            return size
        if max(one.numbers) >= size:
            raise ValueError(f"feature {one.name} has number {max(one.numbers)}, the observation has 0 to {size - 1}")
        return len(one.numbers)

    @staticmethod
    def _numbers(one: MappedFeature, parts: Parts, chance: np.random.Generator) -> NDArray[np.float32]:
        chosen = parts[one.key] if one.numbers is None else parts[one.key][:, list(one.numbers)]
        if one.noise:  # a copy stays within its range, or a server would refuse what training had read
            chosen = np.clip(chosen + chance.normal(0.0, one.noise, chosen.shape), one.low, one.high)
        return chosen.astype(np.float32)
