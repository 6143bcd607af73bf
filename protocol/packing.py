"""What goes into a client's request: numbers and arrays as msgpack carries them, shapes checked before they are sent.

This module knows nothing about sockets or replies, and does not use `protocol.codec`: see `protocol.client`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.errors import BadSchema, BadShape
from protocol.features import CostModel, FeatureTable

__all__ = ["FLOAT", "add_acquired", "add_number", "add_numbers", "cost_model_dict", "handles_of", "matrix"]

FLOAT, _BOOL = np.dtype("<f4"), np.dtype(np.bool_)  # made once: names of types are looked up in every call


def cost_model_dict(cost_model: CostModel) -> dict[str, Any]:
    """A cost model as `hello` has it."""
    return {"call_us": float(cost_model.call_us), "feature_us": [float(us) for us in cost_model.feature_us]}


def handles_of(bots: ArrayLike) -> list[int]:
    """One handle or many, as a list. Raises BadSchema for floats, which round a handle to that of another bot."""
    array = np.array(bots, ndmin=1)
    if array.size and array.dtype.kind not in "iu":
        raise BadSchema(f"bots are {array.dtype}, expected whole numbers as `start` gave them")
    handles: list[int] = array.tolist()
    return handles


def add_acquired(
    message: dict[str, Any],
    table: FeatureTable,
    n_bots: int,
    acquired: ArrayLike,
    costly: ArrayLike,
    failed: ArrayLike | None,
) -> None:
    """Add `acquired` [N, M], `values` of the dense `costly` [N, D] and, if given, `failed` [N, M]; raises BadShape."""
    acquired_NM = matrix(acquired, _BOOL, (n_bots, table.n_queries), "acquired")
    costly_ND = matrix(costly, FLOAT, (n_bots, table.n_costly), "costly")
    message["acquired"] = _pack_bits(acquired_NM)
    message["values"] = costly_ND[table.spread(acquired_NM)].tobytes()
    if failed is not None:
        message["failed"] = _pack_bits(matrix(failed, _BOOL, acquired_NM.shape, "failed"))


def add_number(message: dict[str, Any], name: str, value: float | None) -> None:
    """Add a field unless it is None."""
    if value is not None:
        message[name] = float(value)


def add_numbers(message: dict[str, Any], name: str, values: ArrayLike | None) -> None:
    """Add a field of one number a bot unless it is None."""
    if values is not None:
        message[name] = np.asarray(values, dtype=np.float64).tolist()


def matrix(array: ArrayLike, dtype: np.dtype[Any], shape: tuple[int, ...], name: str) -> NDArray[Any]:
    """The array in this type; raises BadShape unless it is of this shape."""
    matrix = np.ascontiguousarray(array, dtype)
    if matrix.shape != shape:
        raise BadShape(f"{name} has shape {list(matrix.shape)}, expected {list(shape)}")
    return matrix


def _pack_bits(array_NM: NDArray[np.bool_]) -> bytes:
    return np.packbits(array_NM, 1, "little").tobytes()
