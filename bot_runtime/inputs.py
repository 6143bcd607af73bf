"""What an engine sends, checked: `protocol.values`, one number a bot, and features that were asked for.

This module knows nothing about contexts, turns or policies. Nothing is ever clipped or repaired: a value is legal, or
its request is refused with the bot, the feature, what was expected and what came.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.errors import BadShape, MissingFeature, NonFinite, OutOfRange, UnrequestedFeature
from protocol.features import CostModel, Feature, FeatureTable
from protocol.messages import MAX_FRAME
from protocol.values import check_shape, check_values

__all__ = ["FeatureChecks", "check_costs", "per_bot", "seeds", "turns"]

_MAX_SEED = 2**64 - 1
_FLOAT, _BOOL = np.dtype(np.float32), np.dtype(np.bool_)

_Floats = NDArray[np.float32]
_Bools = NDArray[np.bool_]


def check_costs(model: CostModel, table: FeatureTable) -> None:
    """Raises BadShape unless the cost model prices exactly the table's costly features."""
    if len(model.feature_us) != table.n_queries:
        raise BadShape(f"cost_model.feature_us has {len(model.feature_us)} costs, expected {table.n_queries}")


def per_bot(
    name: str, numbers: Sequence[float] | NDArray[np.floating] | float, n_bots: int, low: float, high: float
) -> NDArray[np.float64]:
    """One number a bot, shape [N]. Raises BadShape, NonFinite, OutOfRange (outside `low` to `high`)."""
    numbers_N = np.array(numbers, dtype=np.float64)
    if numbers_N.shape != (n_bots,):
        raise BadShape(f"{name} has shape {list(numbers_N.shape)}, expected [{n_bots}], one number a bot")
    legal_N = (numbers_N >= low) & (numbers_N <= high)  # false for NaN
    if legal_N.all():
        return numbers_N
    finite_N = np.isfinite(numbers_N)
    if not finite_N.all():
        row = int(np.argmin(finite_N))
        raise NonFinite(f"{name} of bot {row} of the message is {numbers_N[row]}, expected a finite number")
    row = int(np.argmin(legal_N))
    raise OutOfRange(f"{name} of bot {row} of the message is {numbers_N[row]}, expected {low:g} to {high:g}")


def seeds(numbers: Sequence[int] | NDArray[np.integer], n_bots: int) -> NDArray[np.uint64]:
    """One seed a bot, shape [N]. Raises BadShape, OutOfRange (outside 0 to 2^64 - 1)."""
    if len(numbers) != n_bots:
        raise BadShape(f"seeds has {len(numbers)} numbers, expected {n_bots}, one a bot")
    for row, seed in enumerate(numbers):
        if not 0 <= seed <= _MAX_SEED:
            raise OutOfRange(f"seed of bot {row} of the message is {seed}, expected 0 to {_MAX_SEED}")
    return np.array([int(seed) for seed in numbers], dtype=np.uint64)


def turns(numbers: Sequence[int] | NDArray[np.integer], n_bots: int) -> NDArray[np.int64]:
    """How many turns each bot has taken, shape [N]. Raises BadShape, OutOfRange (outside 0 to `MAX_FRAME`)."""
    if len(numbers) != n_bots:
        raise BadShape(f"turns has {len(numbers)} numbers, expected {n_bots}, one a bot")
    for row, taken in enumerate(numbers):
        if not 0 <= taken <= MAX_FRAME:
            raise OutOfRange(f"turns of bot {row} of the message are {taken}, expected 0 to {MAX_FRAME}")
    return np.array([int(taken) for taken in numbers], dtype=np.int64)


class FeatureChecks:
    """The checks of one feature table for up to `capacity` bots, with room for what they compute on the way."""

    def __init__(self, table: FeatureTable, capacity: int) -> None:
        self._table = table
        self._free_range, self._costly_range = table.free_range, table.costly_range
        low, high = self._costly_range
        self._zero_is_legal = bool((low <= 0.0).all() and (high >= 0.0).all())
        self._room = np.empty((2, capacity * max(table.n_free, table.n_costly)), dtype=np.bool_)
        self._rooms: dict[tuple[int, ...], tuple[_Bools, _Bools]] = {}  # parts of it by shape

    def free(self, free_NF: _Floats, handles_N: NDArray[np.int64]) -> None:
        """Raises BadShape, NonFinite or OutOfRange unless these are legal free numbers of these bots."""
        check_shape("free", free_NF, (handles_N.size, self._table.n_free), _FLOAT)
        if not self._within(free_NF, self._free_range):
            check_values(free_NF, None, handles_N, self._table.free, self._free_range)

    def query(self, acquired_NM: _Bools, failed_NM: _Bools | None, handles_N: NDArray[np.int64]) -> _Bools:
        """What an engine that decides for itself asked for: what it acquired or failed, [N, M]. Raises BadShape."""
        shape = handles_N.size, self._table.n_queries
        check_shape("acquired", acquired_NM, shape, _BOOL)
        if failed_NM is None:
            return acquired_NM.copy()
        check_shape("failed", failed_NM, shape, _BOOL)
        asked_NM: _Bools = acquired_NM | failed_NM
        return asked_NM

    def costly(
        self,
        acquired_NM: _Bools,
        costly_ND: _Floats,
        failed_NM: _Bools | None,
        query_NM: _Bools,
        handles_N: NDArray[np.int64],
        out_ND: _Floats,
    ) -> _Bools:
        """What was really acquired [N, M] (a failed feature was not); its values go to `out_ND`, zero where not
        acquired.

        Raises BadShape; UnrequestedFeature for anything beyond the query; MissingFeature where the query is not
        covered; NonFinite and OutOfRange for acquired values. Other values are never looked at.
        """
        table, n_bots = self._table, handles_N.size
        check_shape("acquired", acquired_NM, (n_bots, table.n_queries), _BOOL)
        check_shape("values", costly_ND, (n_bots, table.n_costly), _FLOAT)
        known_NM = query_NM
        if failed_NM is not None:
            check_shape("failed", failed_NM, (n_bots, table.n_queries), _BOOL)
            known_NM = query_NM & ~failed_NM
            _check_answered(acquired_NM | failed_NM, query_NM, handles_N, table.costly)
        elif acquired_NM.tobytes() != query_NM.tobytes():
            _check_answered(acquired_NM, query_NM, handles_N, table.costly)
        known_ND = table.spread(known_NM)
        out_ND.fill(0.0)
        np.copyto(out_ND, costly_ND, where=known_ND)
        if not (self._zero_is_legal and self._within(out_ND, self._costly_range)):
            check_values(costly_ND, known_ND, handles_N, table.costly, self._costly_range)
        return known_NM

    def _within(self, numbers: _Floats, limits: tuple[_Floats, _Floats]) -> bool:
        """Whether all are; not where one is NaN."""
        rooms = self._rooms.get(numbers.shape)
        if rooms is None:
            first, second = (room[: numbers.size].reshape(numbers.shape) for room in self._room)
            rooms = self._rooms[numbers.shape] = (first, second)
        high_enough, low_enough = rooms
        np.greater_equal(numbers, limits[0], high_enough)
        np.less_equal(numbers, limits[1], low_enough)
        np.logical_and(high_enough, low_enough, low_enough)
        return int(np.count_nonzero(low_enough)) == numbers.size


def _check_answered(
    answered_NM: _Bools, query_NM: _Bools, handles_N: NDArray[np.int64], costly: tuple[Feature, ...]
) -> None:
    wrong_NM = answered_NM != query_NM
    if not wrong_NM.any():
        return
    row, column = (int(index) for index in np.argwhere(wrong_NM)[0])
    where = f"{costly[column].name} of bot {handles_N[row]}"
    if answered_NM[row, column]:
        raise UnrequestedFeature(f"{where} came or failed, but was not asked for")
    raise MissingFeature(f"{where} was asked for, and neither came nor is marked failed")
