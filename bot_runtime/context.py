"""The arena: every bot's context in preallocated arrays, one row a bot.

This module knows nothing about handles, messages, budgets or what a policy is. A context is what the policies read of
the past: cached keys and values, the last hidden state, return-to-go, and the counter of the noise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from bot_runtime.manifest import Manifest
from bot_runtime.policy import Cache, Step

__all__ = ["Contexts"]

_Ints = NDArray[np.int64]


class Contexts:
    """B rows, all zero where no bot lives. Methods take slots [N]: distinct row numbers, in the caller's order.

    The ring holds S = K - 1 turns a bot; turn t lies in slot t mod S, and `ages` says how many turns ago each was
    written (K: empty). `turns` counts the turns that the context took; it is the t of the noise and of the ring.
    Without a context S and W are 0: those arrays are empty, and the counter, the return-to-go and the last action are
    all that is kept.
    """

    def __init__(self, manifest: Manifest, capacity: int) -> None:
        self._empty_age = manifest.context_length
        self._n_slots = manifest.n_slots
        shape = (manifest.n_layers, capacity, manifest.n_heads, manifest.n_slots, manifest.head_dim)
        self._keys = np.zeros(shape, dtype=np.float32)
        self._values = np.zeros(shape, dtype=np.float32)
        # The graph wants [L, N, ...] in one piece: gathered into memory that is kept, for fresh pages cost more than
        # the copy does.
        self._gathered = np.empty((2, self._keys.size), dtype=np.float32)
        self._ages_BS = np.full((capacity, manifest.n_slots), self._empty_age, dtype=np.int64)
        self._hidden_BW = np.zeros((capacity, manifest.width), dtype=np.float32)
        self._seeds_B = np.zeros(capacity, dtype=np.uint64)
        self._turns_B = np.zeros(capacity, dtype=np.int64)
        self._returns_to_go_B = np.zeros(capacity, dtype=np.float64)
        self._last_action_BA = np.zeros((capacity, manifest.action.size), dtype=np.float32)

    def begin(self, slots_N: _Ints, seeds_N: NDArray[np.uint64], target_returns_N: NDArray[np.float64]) -> None:
        """Give zeroed rows to new bots: an empty context, their seeds, and their target returns to go."""
        self._seeds_B[slots_N] = seeds_N
        self._returns_to_go_B[slots_N] = target_returns_N

    def clear(self, slots_N: _Ints) -> None:
        """Zero every number of these rows, so that nothing of a stopped bot reaches the next one."""
        self._keys[:, slots_N] = 0.0
        self._values[:, slots_N] = 0.0
        self._ages_BS[slots_N] = self._empty_age
        for array in (self._hidden_BW, self._seeds_B, self._turns_B, self._returns_to_go_B, self._last_action_BA):
            array[slots_N] = 0

    def hidden(self, slots_N: _Ints) -> NDArray[np.float32]:
        """The trunk's state after each bot's last turn, zeros before its first, shape [N, W]."""
        return self._hidden_BW[slots_N]

    def seeds(self, slots_N: _Ints) -> NDArray[np.uint64]:
        """The seed of each bot's noise, shape [N]."""
        return self._seeds_B[slots_N]

    def turns(self, slots_N: _Ints) -> _Ints:
        """How many turns each context took, shape [N]."""
        return self._turns_B[slots_N]

    def returns_to_go(self, slots_N: _Ints) -> NDArray[np.float64]:
        """What is left of each bot's target return, shape [N]."""
        return self._returns_to_go_B[slots_N]

    def last_action(self, slots_N: _Ints) -> NDArray[np.float32]:
        """The action of each bot's last turn (zeros before its first), shape [N, A]."""
        return self._last_action_BA[slots_N]

    def cache(self, slots_N: _Ints) -> Cache:
        """Keys and values [L, N, H, S, d] of these bots; valid until the next call of this method."""
        layers, capacity, *rest = self._keys.shape
        if slots_N.size == capacity and bool((slots_N[1:] > slots_N[:-1]).all()):  # all rows, in order
            return Cache(self._keys, self._values)
        shape = (layers, slots_N.size, *rest)
        keys, values = (row[: math.prod(shape)].reshape(shape) for row in self._gathered)
        # mode="clip" writes straight into `out` (slots are always valid); "raise" would buffer it.
        np.take(self._keys, slots_N, axis=1, out=keys, mode="clip")
        np.take(self._values, slots_N, axis=1, out=values, mode="clip")
        return Cache(keys, values)

    def ages(self, slots_N: _Ints) -> _Ints:
        """The age of each ring slot, 1 to K - 1, or K where it is empty, shape [N, S]."""
        return self._ages_BS[slots_N]

    def spend(self, slots_N: _Ints, returns_to_go_N: NDArray[np.float64]) -> None:
        """Set what is left of each bot's target return."""
        self._returns_to_go_B[slots_N] = returns_to_go_N

    def advance(self, slots_N: _Ints, step: Step) -> None:
        """Append one turn to each context."""
        if self._n_slots:
            self._remember(slots_N, step)
        self._last_action_BA[slots_N] = step.action_NA
        self._turns_B[slots_N] += 1

    def _remember(self, slots_N: _Ints, step: Step) -> None:
        ring_N = self._turns_B[slots_N] % self._n_slots
        self._keys[:, slots_N, :, ring_N] = step.new_keys.swapaxes(0, 1)  # advanced indices put N first
        self._values[:, slots_N, :, ring_N] = step.new_values.swapaxes(0, 1)
        self._ages_BS[slots_N] = np.minimum(self._ages_BS[slots_N] + 1, self._empty_age)
        self._ages_BS[slots_N, ring_N] = 1
        self._hidden_BW[slots_N] = step.hidden_NW
