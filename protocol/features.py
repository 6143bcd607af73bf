"""The feature table, the cost model and the action layout: what both ends must agree on before a bot plays.

This module knows nothing about messages, bytes or sockets.

Shape letters used here and everywhere else: N bots, F free numbers, M costly features, D costly numbers, A action
numbers.
"""

from __future__ import annotations

import re
from functools import cached_property
from typing import ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_FEATURES", "MAX_FEATURE_SIZE", "ActionComponent", "ActionSpec", "CostModel", "Feature", "FeatureTable"]

MAX_FEATURES = 1024
MAX_FEATURE_SIZE = 4096
_NAME = re.compile(r"^[a-z][a-z0-9_]{0,63}$")
_UNBOUNDED = 1e6
_MAX_NUMBER = float(np.finfo(np.float32).max)  # a limit beyond would be infinite, and no limit, as float32


class Feature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A named group of numbers acquired together. `cost_us` 0 means *free*: always sent, never asked for."""

    name: str
    size: int
    cost_us: float = 0.0
    low: float = -_UNBOUNDED
    high: float = _UNBOUNDED

    def __post_init__(self) -> None:
        if not _NAME.match(self.name):
            raise ValueError(f"feature name {self.name!r} does not match {_NAME.pattern}")
        if not 1 <= self.size <= MAX_FEATURE_SIZE:
            raise ValueError(f"feature {self.name} has size {self.size}, expected 1 to {MAX_FEATURE_SIZE}")
        if not 0.0 <= self.cost_us <= _UNBOUNDED:
            raise ValueError(f"feature {self.name} has cost_us {self.cost_us}, expected 0 to {_UNBOUNDED:g}")
        if not -_MAX_NUMBER <= self.low < self.high <= _MAX_NUMBER:
            expected = "expected finite as float32 and increasing"
            raise ValueError(f"feature {self.name} has range [{self.low}, {self.high}], {expected}")


class FeatureTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The features of one bundle, in wire order: every vector of free or costly numbers follows this order."""

    features: tuple[Feature, ...]

    def __post_init__(self) -> None:
        names = [feature.name for feature in self.features]
        if len(set(names)) != len(names):
            raise ValueError("feature names must be unique")
        if not 1 <= len(names) <= MAX_FEATURES:
            raise ValueError(f"a feature table has {len(names)} features, expected 1 to {MAX_FEATURES}")

    @cached_property
    def free(self) -> tuple[Feature, ...]:
        """Features whose cost is 0, in order."""
        return tuple(feature for feature in self.features if feature.cost_us == 0.0)

    @cached_property
    def costly(self) -> tuple[Feature, ...]:
        """Features that must be asked for, in order."""
        return tuple(feature for feature in self.features if feature.cost_us > 0.0)

    @cached_property
    def n_free(self) -> int:
        """F: how many free numbers a bot sends each frame."""
        return sum(feature.size for feature in self.free)

    @cached_property
    def n_queries(self) -> int:
        """M: how many costly features there are."""
        return len(self.costly)

    @cached_property
    def n_costly(self) -> int:
        """D: how many numbers all costly features have together."""
        return sum(feature.size for feature in self.costly)

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Numbers in each costly feature, shape [M]."""
        return np.array([feature.size for feature in self.costly], dtype=np.int64)

    @cached_property
    def costs_us(self) -> NDArray[np.float64]:
        """Declared cost of each costly feature in µs, shape [M] (the paper's f)."""
        return np.array([feature.cost_us for feature in self.costly], dtype=np.float64)

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """Index of the costly feature that each costly number belongs to, shape [D]."""
        return np.repeat(np.arange(self.n_queries), self.sizes)

    def spread(self, mask_NM: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Of each costly number, shape [N, D], what is said of the feature that it belongs to."""
        return mask_NM.repeat(self._repeats, 1)

    @cached_property
    def _repeats(self) -> int | NDArray[np.int64]:
        sizes = set(self.sizes.tolist())
        return sizes.pop() if len(sizes) == 1 else self.sizes  # one for all takes a fifth less time

    @cached_property
    def free_range(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest legal value of each free number, each shape [F]."""
        return _ranges(self.free)

    @cached_property
    def costly_range(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest legal value of each costly number, each shape [D]."""
        return _ranges(self.costly)


class CostModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """Predicted µs of acquiring a query: `call_us` once when anything is asked for, plus each feature's own cost."""

    call_us: float
    feature_us: tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(0.0 <= us <= _UNBOUNDED for us in (self.call_us, *self.feature_us)):
            raise ValueError(f"every cost must be finite and within 0 to {_UNBOUNDED:g} µs")

    @classmethod
    def declared(cls, table: FeatureTable) -> CostModel:
        """The costs that the feature table itself declares, without a cost per call."""
        return cls(call_us=0.0, feature_us=tuple(float(us) for us in table.costs_us))

    @cached_property
    def costs_us(self) -> NDArray[np.float64]:
        """Cost of each costly feature in µs, shape [M]."""
        return np.array(self.feature_us, dtype=np.float64)

    @property
    def full_us(self) -> float:
        """Cost in µs of asking for everything: the denominator of every percentage that we print."""
        return self.call_us + float(self.costs_us.sum())

    def query_cost_us(self, query_NM: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Predicted cost in µs of each bot's query, shape [N]."""
        return query_NM @ self.costs_us + self.call_us * query_NM.any(axis=1)


class ActionComponent(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number of an action; `safe` is what a bot does when nothing better is known."""

    size: ClassVar[int] = 1
    name: str
    low: float
    high: float
    safe: float = 0.0

    def __post_init__(self) -> None:
        if not _NAME.match(self.name):
            raise ValueError(f"action component name {self.name!r} does not match {_NAME.pattern}")
        if not -_MAX_NUMBER <= self.low < self.high <= _MAX_NUMBER:
            expected = "expected finite as float32 and increasing"
            raise ValueError(f"action component {self.name} has range [{self.low}, {self.high}], {expected}")
        if not self.low <= self.safe <= self.high:
            raise ValueError(
                f"action component {self.name} has safe value {self.safe} outside [{self.low}, {self.high}]"
            )


class ActionSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True, dict=True):
    """The numbers of an action, in wire order."""

    components: tuple[ActionComponent, ...]

    def __post_init__(self) -> None:
        if not 1 <= len(self.components) <= MAX_FEATURES:
            raise ValueError(f"an action has {len(self.components)} components, expected 1 to {MAX_FEATURES}")

    @property
    def size(self) -> int:
        """A: how many numbers an action has."""
        return len(self.components)

    @cached_property
    def range(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest legal value of each number, each shape [A]."""
        return _ranges(self.components)

    @cached_property
    def safe(self) -> NDArray[np.float32]:
        """The declared safe action, shape [A]."""
        return np.array([component.safe for component in self.components], dtype=np.float32)


def _ranges(
    parts: tuple[Feature, ...] | tuple[ActionComponent, ...],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    sizes = [part.size for part in parts]
    low = np.repeat(np.array([part.low for part in parts], dtype=np.float32), sizes)
    high = np.repeat(np.array([part.high for part in parts], dtype=np.float32), sizes)
    return low, high
