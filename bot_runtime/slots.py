"""Which bot lives in which row of the arena: handles, and generations that make an old handle fail.

This module knows nothing about what a row holds. A handle is `generation << 32 | slot`, 63 bits, opaque to everyone
else.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.errors import BadSchema, BadShape, NoBot, TooManyBots

__all__ = ["Slots"]

_SLOT_BITS = 32
_GENERATIONS = 2**31
_RETRY_AFTER_S = 1.0


class Slots:
    """A fixed number of slots. `first_generation` should differ between processes, so that no handle outlives one."""

    def __init__(self, capacity: int, *, first_generation: int) -> None:
        self._live_B = np.zeros(capacity, dtype=np.bool_)
        self._generations_B = np.full(capacity, first_generation % _GENERATIONS, dtype=np.int64)

    @property
    def capacity(self) -> int:
        """B: how many bots fit."""
        return self._live_B.size

    @property
    def n_live(self) -> int:
        """How many bots there are."""
        return int(self._live_B.sum())

    def take(self, count: int) -> NDArray[np.int64]:
        """Occupy the `count` lowest free slots, shape [count]. Raises TooManyBots, taking none, if fewer are."""
        if count > self.capacity:
            raise TooManyBots(f"{count} bots never fit: there are {self.capacity} slots")
        free = np.flatnonzero(~self._live_B)
        if count > free.size:
            raise TooManyBots(
                f"{count} bots do not fit: {self.n_live} of {self.capacity} slots are taken",
                retry_after_s=_RETRY_AFTER_S,
            )
        slots_N = free[:count].astype(np.int64)
        self._live_B[slots_N] = True
        return slots_N

    def release(self, slots_N: NDArray[np.int64]) -> None:
        """Free these slots; every handle made for them fails from now on."""
        self._live_B[slots_N] = False
        self._generations_B[slots_N] = (self._generations_B[slots_N] + 1) % _GENERATIONS

    def handles(self, slots_N: NDArray[np.int64]) -> NDArray[np.int64]:
        """The handles of live slots, shape [N]."""
        return (self._generations_B[slots_N] << _SLOT_BITS) | slots_N

    def resolve(self, handles_N: NDArray[np.int64]) -> NDArray[np.int64]:
        """The slots of these handles, shape [N].

        Raises BadShape unless there is at least one and the shape is [N], BadSchema when one is named twice, NoBot
        when one is unknown or belongs to a bot that was stopped.
        """
        if handles_N.ndim != 1 or handles_N.size == 0 or handles_N.dtype != np.int64:
            raise BadShape(f"bots are {handles_N.dtype} of shape {list(handles_N.shape)}, expected int64 [N], N >= 1")
        slots_N = handles_N & (2**_SLOT_BITS - 1)
        generations_N = handles_N >> _SLOT_BITS
        known_N = (handles_N >= 0) & (slots_N < self.capacity)
        slots_N = np.where(known_N, slots_N, 0)
        known_N &= self._live_B[slots_N] & (self._generations_B[slots_N] == generations_N)
        if not known_N.all():
            raise NoBot(f"bot {int(handles_N[int(np.argmin(known_N))])} is unknown or was stopped")
        if len(set(slots_N.tolist())) < slots_N.size:
            twice = int(handles_N[int(np.argmax(np.bincount(slots_N)[slots_N] > 1))])
            raise BadSchema(f"bot {twice} is named more than once, expected at most once a message")
        return slots_N
