"""The arena: every bot's context in preallocated arrays, one row a bot.

This module knows nothing about handles, messages, budgets or what a policy is. A context is what the policies read of
the past: cached keys and values, the last hidden state, return-to-go, and the counter of the noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bot_runtime.batch import Batch, Rows
from bot_runtime.manifest import Manifest
from bot_runtime.noise import Noise

__all__ = ["Contexts"]

_Floats = NDArray[np.float32]
_Ints = NDArray[np.int64]


class Contexts:
    """B rows, all zero where no bot lives. Methods take a batch, or slots [N]: distinct row numbers, in any order.

    The ring holds S = K - 1 turns a bot; turn t lies in slot t mod S. A bot's *place* says where its ring is: t before
    turn t as long as that is less than S, then S + t mod S; the graph knows from it how old each slot is and which are
    empty. `turns` counts the turns that the context took, the t of the noise. Without a context S and W are 0: those
    arrays are empty, and the counter, the return-to-go and the last action are all that is kept.
    """

    def __init__(self, manifest: Manifest, capacity: int) -> None:
        self._manifest = manifest
        self._n_slots = manifest.n_slots
        self._rows, self._copies = Rows(manifest, capacity), Rows(manifest, capacity)
        self._outputs = np.zeros(Batch.n_outputs(manifest, capacity), dtype=np.float32)
        self._seeds_B = np.zeros(capacity, dtype=np.uint64)
        self._turns_B = np.zeros(capacity, dtype=np.int64)
        self._returns_to_go_B = np.zeros(capacity, dtype=np.float64)
        self._last_action_BA = np.zeros((capacity, manifest.action.size), dtype=np.float32)

    def batch(self, slots_N: _Ints, outputs: _Floats | None = None) -> Batch:
        """The bots of these slots, to be run together again and again until one of them is cleared.

        All batches share their outputs but those that are given other ones.
        """
        count = self._manifest.features.n_queries + (self._manifest.action.size if self._manifest.samples_action else 0)
        noise = Noise(self._seeds_B[slots_N], count)
        outputs = self._outputs if outputs is None else outputs
        return Batch(self._manifest, self._rows, self._copies, outputs, slots_N, noise)

    def more_outputs(self) -> _Floats:
        """Outputs for batches that must not share those of the others."""
        return np.empty_like(self._outputs)

    def begin(
        self,
        slots_N: _Ints,
        seeds_N: NDArray[np.uint64],
        target_returns_N: NDArray[np.float64],
        turns_N: _Ints | None = None,
    ) -> None:
        """Give zeroed rows to new bots: an empty context, their seeds, and their target returns to go.

        Where `turns_N` is given, so many turns are over. They count for the noise, and for where the ring goes on: it
        is all zeros, and once turns of before have gone over it, the context is theirs to the bit.
        """
        self._seeds_B[slots_N] = seeds_N
        self._returns_to_go_B[slots_N] = target_returns_N
        if turns_N is not None:
            self._turns_B[slots_N] = turns_N
            if self._n_slots:
                around_N = self._n_slots + turns_N % self._n_slots
                self._rows.place[slots_N] = np.where(turns_N < self._n_slots, turns_N, around_N)

    def clear(self, slots_N: _Ints) -> None:
        """Zero every number of these rows, so that nothing of a stopped bot reaches the next one."""
        self._rows.clear(slots_N)
        for array in (self._seeds_B, self._turns_B, self._returns_to_go_B, self._last_action_BA):
            array[slots_N] = 0

    def turns(self, batch: Batch) -> _Ints:
        """How many turns each context took, shape [N]."""
        return self._turns_B[batch.at]

    def hidden(self, batch: Batch) -> _Floats:
        """Each bot's hidden state after its last turn, a copy, shape [N, W]."""
        return self._rows.before[batch.at, : self._manifest.width].copy()

    def returns_to_go(self, batch: Batch) -> NDArray[np.float64]:
        """What is left of each bot's target return, shape [N]."""
        return self._returns_to_go_B[batch.at]

    def last_action(self, batch: Batch) -> _Floats:
        """The action of each bot's last turn (zeros before its first), shape [N, A]."""
        return self._last_action_BA[batch.at]

    def acquired(self, batch: Batch) -> tuple[_Floats, _Floats]:
        """What each bot acquired in its last turn: costly numbers [N, D] and the query [N, M], 0 or 1."""
        costly_ND, query_NM = np.split(self._rows.acquired[batch.at], [self._manifest.features.n_costly], axis=1)
        return costly_ND, query_NM

    def noise(self, batch: Batch) -> _Floats:
        """Uniform numbers of this turn, for each query and, where any is read, each number of the action, [N, ...]."""
        return batch.noise.at(self._turns_B[batch.at])

    def spend(self, batch: Batch, returns_to_go_N: NDArray[np.float64]) -> None:
        """Set what is left of each bot's target return."""
        self._returns_to_go_B[batch.at] = returns_to_go_N

    def follow(self, batch: Batch, hidden_NW: _Floats | None, turns_N: _Ints) -> None:
        """Set what a head reads of contexts that are kept elsewhere; a hidden state of None is what it was."""
        if hidden_NW is not None:
            self._rows.before[batch.at, : self._manifest.width] = hidden_NW
        self._turns_B[batch.at] = turns_N

    def advance(self, batch: Batch, action_NA: _Floats, kept_N: NDArray[np.bool_] | None = None) -> None:
        """Append to each context the turn that the batch has just run, and that these actions came of.

        Where `kept_N` is given, only to those contexts; the others stay as they are.
        """
        place_N = batch.place_N
        first = int(place_N[0])
        together = batch.n_bots == 1 or np.count_nonzero(place_N == first) == batch.n_bots
        if kept_N is not None or batch.copies is not None or not together:
            self._advance_some(batch, action_NA, np.flatnonzero(np.ones(batch.n_bots) if kept_N is None else kept_N))
            return
        if self._n_slots:
            batch.memory[:, :, :, :, first % self._n_slots] = batch.tokens
            place_N.fill(self._after(first))
            np.copyto(batch.past_NW, batch.hidden_NW)
        self._last_action_BA[batch.at] = action_NA
        turns_N = self._turns_B[batch.at]  # a view: the rows lie side by side
        turns_N += 1

    def _advance_some(self, batch: Batch, action_NA: _Floats, kept: _Ints) -> None:
        """The same in any order and of any of the batch's rows."""
        slots_N = batch.slots_N[kept]
        if self._n_slots:
            place_N = self._rows.place[slots_N]
            tokens = np.moveaxis(batch.tokens[:, :, kept], 2, 0)  # advanced indices put N first
            self._rows.memory[:, :, slots_N, :, place_N % self._n_slots] = tokens
            self._rows.place[slots_N] = np.where(place_N + 1 < 2 * self._n_slots, place_N + 1, self._n_slots)
            self._rows.before[slots_N, : self._manifest.width] = batch.hidden_NW[kept]
        self._last_action_BA[slots_N] = action_NA[kept]
        self._turns_B[slots_N] += 1

    def _after(self, place: int) -> int:
        return place + 1 if place + 1 < 2 * self._n_slots else self._n_slots
