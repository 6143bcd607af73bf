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
from protocol.values import check_shape, check_values

__all__ = ["check_costs", "check_features", "check_free", "per_bot", "seeds"]

_MAX_SEED = 2**64 - 1

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


def check_free(free_NF: _Floats, handles_N: NDArray[np.int64], table: FeatureTable) -> None:
    """Raises BadShape, NonFinite or OutOfRange unless these are legal free numbers of these bots."""
    check_shape("free", free_NF, (handles_N.size, table.n_free), np.float32)
    check_values(free_NF, None, handles_N, table.free, table.free_range)


def check_features(
    acquired_NM: _Bools,
    costly_ND: _Floats,
    failed_NM: _Bools | None,
    query_NM: _Bools,
    handles_N: NDArray[np.int64],
    table: FeatureTable,
) -> tuple[_Bools, _Floats]:
    """What was really acquired [N, M] (a failed feature was not), and its values [N, D], zero where not acquired.

    Raises BadShape; UnrequestedFeature for anything beyond the query; MissingFeature where the query is not covered;
    NonFinite and OutOfRange for acquired values. Other values are never looked at.
    """
    bits, numbers = (handles_N.size, table.n_queries), (handles_N.size, table.n_costly)
    check_shape("acquired", acquired_NM, bits, np.bool_)
    check_shape("values", costly_ND, numbers, np.float32)
    answered_NM, known_NM = acquired_NM, query_NM
    if failed_NM is not None:
        check_shape("failed", failed_NM, bits, np.bool_)
        answered_NM, known_NM = acquired_NM | failed_NM, query_NM & ~failed_NM
    _check_answered(answered_NM, query_NM, handles_N, table.costly)
    known_ND = known_NM[:, table.owner]
    check_values(costly_ND, known_ND, handles_N, table.costly, table.costly_range)
    return known_NM, np.where(known_ND, costly_ND, np.float32(0.0))


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
