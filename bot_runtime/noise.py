"""Counter-based uniform noise: the same seed, turn and index give the same number on every machine, in any batch.

This module knows nothing about bots or policies. SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom
number generators", OOPSLA 2014) is used as a hash: a seed selects a stream, a turn a row of it, an index a number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Noise", "mix", "uniforms"]

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_FLOAT32_STEP = np.float32(2.0**-24)  # 24 bits fill a float32's mantissa, so that no result rounds up to 1
_AHEAD = 16  # turns of one bot; fewer of more bots


def mix(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """SplitMix64's output function of each element, any shape."""
    mixed = _half_mixed(state)
    mixed ^= mixed >> np.uint64(31)
    return mixed


def _half_mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The same without its last step, which leaves the highest 31 bits as they are."""
    mixed = state >> np.uint64(30)
    mixed ^= state
    mixed *= _MIX_1
    mixed ^= mixed >> np.uint64(27)
    mixed *= _MIX_2
    return mixed


def uniforms(seeds_N: NDArray[np.uint64], turns_N: NDArray[np.int64], count: int) -> NDArray[np.float32]:
    """`count` numbers in [0, 1) for each bot, shape [N, count]; multiples of 2^-24.

    Row n depends on its own seed and turn only, and a longer row starts with the shorter one.
    """
    return _numbers(_streams(seeds_N), np.asarray(turns_N), _indices(count))


def _streams(seeds_N: NDArray[np.uint64]) -> NDArray[np.uint64]:
    return mix(np.asarray(seeds_N, dtype=np.uint64) + _GOLDEN)


def _indices(count: int) -> NDArray[np.uint64]:
    return np.arange(1, count + 1, dtype=np.uint64) * _GOLDEN


def _numbers(
    streams_N: NDArray[np.uint64], turns: NDArray[np.int64], indices: NDArray[np.uint64]
) -> NDArray[np.float32]:
    """Of turns [..., N]: [..., N, count]."""
    rows = turns.astype(np.uint64)
    rows *= _GOLDEN
    rows += streams_N
    bits = _half_mixed(np.add.outer(mix(rows), indices))
    bits >>= np.uint64(40)
    numbers = bits.view(np.int64).astype(np.float32)  # twice as fast as from unsigned ones
    numbers *= _FLOAT32_STEP
    return numbers


class Noise:
    """The noise of N bots, turn by turn; of a few bots some turns ahead, for that costs hardly more than one."""

    def __init__(self, seeds_N: NDArray[np.uint64], count: int) -> None:
        self._streams_N, self._indices = _streams(seeds_N), _indices(count)
        self._ahead = max(1, _AHEAD // seeds_N.size)
        self._rows: dict[bytes, NDArray[np.float32]] = {}  # by the turns

    def at(self, turns_N: NDArray[np.int64]) -> NDArray[np.float32]:
        """`uniforms` of these turns, shape [N, count]."""
        if self._ahead == 1:
            return _numbers(self._streams_N, turns_N, self._indices)
        key = turns_N.tobytes()
        if key not in self._rows:
            turns_TN = turns_N + np.arange(self._ahead)[:, None]
            block = _numbers(self._streams_N, turns_TN, self._indices)
            self._rows = {turns.tobytes(): rows for turns, rows in zip(turns_TN, block, strict=True)}
        return self._rows[key]
