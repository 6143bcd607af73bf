"""The blobs, bits and ragged values of a message to numpy arrays and back, shapes, finiteness and ranges checked.

This module knows nothing about messages, sockets or bots. Shape letters as in `protocol.features`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from protocol.codec import Format
from protocol.errors import BadShape, NonFinite, OutOfRange
from protocol.features import Feature, FeatureTable
from protocol.messages import Bits, Blob

__all__ = ["bits", "check_range", "floats", "numbers", "pack_bits", "pack_floats", "pack_values", "unpack_values"]

Array = TypeVar("Array", NDArray[np.float32], NDArray[np.float64])


def floats(blob: Blob, shape: tuple[int, int], name: str) -> NDArray[np.float32]:
    """A blob as float32 of `shape`; raises BadShape, NonFinite, OutOfRange (a number that float32 cannot hold)."""
    if isinstance(blob, bytes):
        return _finite(_from_bytes(blob, shape, name), name)
    _check_rows(blob, shape, name)
    return _narrow(np.array(blob, dtype=np.float64).reshape(shape), name)


def bits(blob: Bits, shape: tuple[int, int], name: str) -> NDArray[np.bool_]:
    """Bits as bool of `shape`; raises BadShape, also for a bit set beyond the last feature."""
    rows, columns = shape
    if not isinstance(blob, bytes):
        _check_rows(blob, shape, name)
        return np.array(blob, dtype=np.bool_).reshape(shape)
    row_bytes = -(-columns // 8)
    if len(blob) != rows * row_bytes:
        raise BadShape(f"{name} has {len(blob)} bytes, expected {rows} rows of {row_bytes} ({columns} bits)")
    packed = np.frombuffer(blob, dtype=np.uint8).reshape(rows, row_bytes)
    unpacked = np.unpackbits(packed, axis=1, bitorder="little").view(np.bool_)
    if unpacked[:, columns:].any():
        raise BadShape(f"{name} sets bits beyond the last of {columns} features")
    return unpacked[:, :columns]


def numbers(values: Sequence[float] | None, count: int, name: str) -> NDArray[np.float64] | None:
    """One finite number a bot, or None where the message has none; raises BadShape, NonFinite."""
    if values is None:
        return None
    if len(values) != count:
        raise BadShape(f"{name} has {len(values)} numbers, expected {count}, one a bot")
    array = np.array(values, dtype=np.float64)
    if not np.isfinite(array).all():
        raise NonFinite(f"{name}[{int(np.flatnonzero(~np.isfinite(array))[0])}] is not finite")
    return array


def check_range(
    values: NDArray[np.float32],
    limits: tuple[NDArray[np.float32], NDArray[np.float32]],
    features: Sequence[Feature],
    where: NDArray[np.bool_] | None = None,
) -> None:
    """Raise OutOfRange, naming bot and feature, if a number [N, n] (only `where` true) leaves its feature's range."""
    low, high = limits
    outside = (values < low) | (values > high)
    if where is not None:
        outside &= where
    if outside.any():
        bot, column = (int(index) for index in np.argwhere(outside)[0])
        feature = _feature_at(features, column)
        raise OutOfRange(
            f"{feature.name} of bot {bot} in the message is {float(values[bot, column]):g}, "
            f"its range is [{feature.low:g}, {feature.high:g}]"
        )


def pack_floats(array: NDArray[np.float32], form: Format) -> Blob:
    """float32 [N, n] as the blob of this format."""
    if form is Format.JSON:
        return cast("list[list[float]]", array.tolist())
    return array.astype("<f4", copy=False).tobytes()


def pack_bits(array: NDArray[np.bool_], form: Format) -> Bits:
    """bool [N, M] as the bits of this format."""
    if form is Format.JSON:
        return cast("list[list[int]]", array.astype(np.uint8).tolist())
    return np.packbits(array, axis=1, bitorder="little").tobytes()


def pack_values(costly_ND: NDArray[np.float32], acquired_NM: NDArray[np.bool_], table: FeatureTable) -> bytes:
    """The acquired numbers alone, bot after bot, feature after feature, as float32 little-endian."""
    return costly_ND[acquired_NM[:, table.owner]].astype("<f4", copy=False).tobytes()


def unpack_values(values: Blob, acquired_NM: NDArray[np.bool_], table: FeatureTable) -> NDArray[np.float32]:
    """Ragged values as dense float32 [N, D], zero where not acquired.

    Raises BadShape (too few or too many numbers for what `acquired` says), NonFinite, OutOfRange.
    """
    present_ND = acquired_NM[:, table.owner]
    dense_ND = np.zeros(present_ND.shape, dtype=np.float32)
    dense_ND[present_ND] = _ragged(values, present_ND)
    check_range(dense_ND, table.costly_range, table.costly, where=present_ND)
    return dense_ND


def _ragged(values: Blob, present_ND: NDArray[np.bool_]) -> NDArray[np.float32]:
    expected = int(np.count_nonzero(present_ND))
    if isinstance(values, bytes):
        return _finite(_from_bytes(values, (1, expected), "values")[0], "values")
    counts = present_ND.sum(axis=1)
    if len(values) != len(counts):
        raise BadShape(f"values has {len(values)} lists, expected {len(counts)}, one a bot")
    for bot, (row, count) in enumerate(zip(values, counts, strict=True)):
        if len(row) != count:
            raise BadShape(f"values of bot {bot} in the message have {len(row)} numbers, its acquired features {count}")
    return _narrow(np.array([number for row in values for number in row], dtype=np.float64), "values")


def _from_bytes(blob: bytes, shape: tuple[int, int], name: str) -> NDArray[np.float32]:
    if len(blob) != 4 * shape[0] * shape[1]:
        raise BadShape(f"{name} has {len(blob)} bytes, expected {4 * shape[0] * shape[1]} for float32 {list(shape)}")
    return np.frombuffer(blob, dtype="<f4").reshape(shape)


def _check_rows(rows: Sequence[Sequence[float]], shape: tuple[int, int], name: str) -> None:
    if len(rows) != shape[0]:
        raise BadShape(f"{name} has {len(rows)} rows, expected {shape[0]}, one a bot")
    for index, row in enumerate(rows):
        if len(row) != shape[1]:
            raise BadShape(f"{name}[{index}] has {len(row)} numbers, expected {shape[1]}")


def _narrow(array: NDArray[np.float64], name: str) -> NDArray[np.float32]:
    _finite(array, name)
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is refused here
        narrow = array.astype(np.float32)
    if not np.isfinite(narrow).all():
        raise OutOfRange(f"{name} holds a number too large for float32")
    return narrow


def _finite(array: Array, name: str) -> Array:
    finite = np.isfinite(array)
    if not finite.all():
        raise NonFinite(f"{name}{[int(i) for i in np.argwhere(~finite)[0]]} is not finite")
    return array


def _feature_at(features: Sequence[Feature], column: int) -> Feature:
    ends = np.cumsum([feature.size for feature in features])
    return features[int(np.searchsorted(ends, column, side="right"))]
