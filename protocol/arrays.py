"""The blobs, bits and ragged values of a message to numpy arrays and back, their shapes checked.

This module knows nothing about messages, sockets or bots, nor which numbers are legal: the bots check that. Shape
letters as in `protocol.features`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from protocol.codec import Format
from protocol.errors import BadShape, OutOfRange
from protocol.features import FeatureTable
from protocol.messages import Bits, Blob

__all__ = ["bits", "floats", "pack_bits", "pack_floats", "unpack_values"]

# Made once, and handed on by position below: names of types and of arguments are looked up in every call.
_FLOAT, _BYTE = np.dtype("<f4"), np.dtype(np.uint8)


def floats(blob: Blob, shape: tuple[int, int], name: str) -> NDArray[np.float32]:
    """A blob as float32 of `shape`; raises BadShape, OutOfRange (a number that float32 cannot hold)."""
    if isinstance(blob, bytes):
        return _from_bytes(blob, shape, name)
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
    packed = np.frombuffer(blob, _BYTE).reshape(rows, row_bytes)
    unpacked = np.unpackbits(packed, 1, None, "little").view(np.bool_)
    if unpacked.shape[1] == columns:
        return unpacked
    if unpacked[:, columns:].any():
        raise BadShape(f"{name} sets bits beyond the last of {columns} features")
    return unpacked[:, :columns]


def pack_floats(array: NDArray[np.float32], form: Format) -> Blob:
    """float32 [N, n] as the blob of this format."""
    if form is Format.JSON:
        return cast("list[list[float]]", array.tolist())
    return np.asarray(array, _FLOAT).tobytes()


def pack_bits(array: NDArray[np.bool_], form: Format) -> Bits:
    """bool [N, M] as the bits of this format."""
    if form is Format.JSON:
        return cast("list[list[int]]", array.astype(np.uint8).tolist())
    return np.packbits(array, 1, "little").tobytes()


def unpack_values(values: Blob, acquired_NM: NDArray[np.bool_], table: FeatureTable) -> NDArray[np.float32]:
    """Ragged values as dense float32 [N, D], zero where not acquired.

    Raises BadShape (too few or too many numbers for what `acquired` says), OutOfRange as `floats` does.
    """
    present_ND = table.spread(acquired_NM)
    dense_ND = np.zeros(present_ND.shape, np.float32)
    dense_ND[present_ND] = _ragged(values, present_ND)
    return dense_ND


def _ragged(values: Blob, present_ND: NDArray[np.bool_]) -> NDArray[np.float32]:
    expected = int(np.count_nonzero(present_ND))
    if isinstance(values, bytes):
        return _from_bytes(values, (1, expected), "values").ravel()
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
    return np.frombuffer(blob, _FLOAT).reshape(shape)


def _check_rows(rows: Sequence[Sequence[float]], shape: tuple[int, int], name: str) -> None:
    if len(rows) != shape[0]:
        raise BadShape(f"{name} has {len(rows)} rows, expected {shape[0]}, one a bot")
    for index, row in enumerate(rows):
        if len(row) != shape[1]:
            raise BadShape(f"{name}[{index}] has {len(row)} numbers, expected {shape[1]}")


def _narrow(array: NDArray[np.float64], name: str) -> NDArray[np.float32]:
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, and is refused here
        narrow = array.astype(np.float32)
    if (np.isinf(narrow) & np.isfinite(array)).any():
        raise OutOfRange(f"{name} holds a number too large for float32")
    return narrow
