"""Numbers of bots, checked: shapes, finite numbers, declared ranges. Nothing is ever clipped or repaired.

This module knows nothing about messages, turns or files. Shape letters as in `protocol.features`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from protocol.errors import BadSchema, BadShape, NonFinite, OutOfRange
from protocol.features import ActionComponent, Feature
from protocol.messages import MAX_FRAME

__all__ = ["check_frame", "check_shape", "check_values"]


def check_frame(frame: int) -> None:
    """Raises BadSchema unless `frame` is within 0 to 2^53."""
    if not 0 <= frame <= MAX_FRAME:
        raise BadSchema(f"frame is {frame}, expected 0 to {MAX_FRAME}")


def check_shape(
    name: str, array: NDArray[np.generic], shape: tuple[int, ...], dtype: np.dtype[np.generic] | type[np.generic]
) -> None:
    """Raises BadShape unless the array is of this shape and type."""
    if array.shape != shape or array.dtype != dtype:
        got = f"{array.dtype} {list(array.shape)}"
        raise BadShape(f"{name} is {got}, expected {np.dtype(dtype)} {list(shape)}, one row a bot")


def check_values(
    values: NDArray[np.float32],
    known: NDArray[np.bool_] | None,
    bots_N: NDArray[np.integer],
    parts: Sequence[Feature | ActionComponent],
    limits: tuple[NDArray[np.float32], NDArray[np.float32]],
) -> None:
    """Raises NonFinite or OutOfRange unless the numbers of these parts, [N, numbers], lie within `limits`.

    Where `known` is given, of the same shape or [N, 1], only those numbers count. `bots_N` names the rows in errors.
    """
    legal = (values >= limits[0]) & (values <= limits[1])  # false for NaN
    if known is not None:
        legal |= ~known
    if legal.all():
        return
    finite = np.isfinite(values) if known is None else np.isfinite(values) | ~known
    bad = ~(legal if finite.all() else finite)
    row, column = (int(index) for index in np.argwhere(bad)[0])
    owner = int(np.repeat(np.arange(len(parts)), [part.size for part in parts])[column])
    part, where = parts[owner], f"of bot {bots_N[row]} is {values[row, column]}"
    if not finite.all():
        raise NonFinite(f"{part.name} {where}, expected a finite number")
    raise OutOfRange(f"{part.name} {where}, expected {part.low:g} to {part.high:g}")
