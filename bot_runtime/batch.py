"""A batch: the bots that one message names, in its order, and the arrays that one turn of them reads and writes.

This module knows nothing about handles, messages or what a policy is. L layers, G heads of keys and values, S cached
turns, d numbers a head, W numbers of hidden state, E prepared numbers; the others are those of `protocol.features`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bot_runtime.manifest import Manifest
from bot_runtime.noise import Noise

__all__ = ["Batch", "Rows"]

_Floats = NDArray[np.float32]
_Ints = NDArray[np.int64]


class Rows:
    """What the graphs read of B bots, zeros to begin with."""

    def __init__(self, manifest: Manifest, capacity: int) -> None:
        table = manifest.features
        self.before = _zeros(capacity, manifest.width + table.n_free + 1)  # the last hidden state, free, return-to-go
        self.target_cost = _zeros(capacity, 1)
        self.prepared = _zeros(capacity, manifest.prepared_width)
        self.acquired = _zeros(capacity, table.n_costly + table.n_queries)  # costly, query
        self.noise = _zeros(capacity, manifest.action.size)
        self.place = np.zeros(capacity, dtype=np.int64)
        heads, head = manifest.token
        ring = (heads, manifest.n_slots, head)
        self.memory = _zeros(manifest.n_layers, 2, capacity, *ring)  # keys and values of each layer

    def first(self, count: int) -> Rows:
        """The same for fewer bots, in the same memory: every array of one layer in one piece."""
        fewer = object.__new__(Rows)
        for name, array in vars(self).items():
            setattr(fewer, name, array[:count])
        layers, both, _, *token = self.memory.shape
        fewer.memory = _view(self.memory.reshape(-1), (layers, both, count, *token))
        return fewer

    def clear(self, slots_N: _Ints) -> None:
        """Zero these rows."""
        for array in vars(self).values():
            (array if array is not self.memory else np.moveaxis(array, 2, 0))[slots_N] = 0


class Batch:
    """N bots. Its arrays are the arena's own rows where those lie side by side, else copies, which `fetch` fills.

    A turn writes `free_NF`, `left_N1` and `target_cost_N1` before the query and `costly_ND`, `query_NM` (0 or 1) and
    `noise_NA` after it. What the graphs answer stands in `probs_NM` and `asked_NE`, then in `action_NA`, `hidden_NW`
    and `tokens` [L, 2, N, G, d], until any batch of the same contexts runs again.
    """

    def __init__(
        self, manifest: Manifest, arena: Rows, copies: Rows, outputs: _Floats, slots_N: _Ints, noise: Noise
    ) -> None:
        table, self.slots_N, self.n_bots, self.noise = manifest.features, slots_N, slots_N.size, noise
        first = int(slots_N[0])
        side_by_side = bool((slots_N == np.arange(first, first + self.n_bots)).all())
        self.at: slice | _Ints = slice(first, first + self.n_bots) if side_by_side else slots_N
        self.arena, self.copies = arena, None if side_by_side else copies.first(self.n_bots)
        rows, at = self.copies or arena, self.at if side_by_side else slice(None)
        self.before_NX, self.target_cost_N1, self.noise_NA = rows.before[at], rows.target_cost[at], rows.noise[at]
        self.prepared_NE, self.acquired_NY = rows.prepared[at], rows.acquired[at]
        self.place_N, self.memory = rows.place[at], rows.memory[:, :, at]
        self.past_NW, self.free_NF, self.left_N1 = np.split(self.before_NX, [manifest.width, -1], axis=1)
        self.costly_ND, self.query_NM = np.split(self.acquired_NY, [table.n_costly], axis=1)
        self.probs_NM, self.asked_NE = _views(outputs, *_asked(manifest, self.n_bots))
        shapes = _acted(manifest, self.n_bots)
        self.action_NA, self.hidden_NW, self.tokens = _views(outputs, *shapes)
        self._acted = outputs[: sum(map(math.prod, shapes))]  # all three
        self._finite = np.empty(self._acted.size, dtype=np.bool_)
        self.runs: dict[str, Callable[[], Any]] = {}  # by graph: kept by the policy that runs it

    @property
    def is_finite(self) -> bool:
        """Whether all that `act` computed is: one NaN in a cache would spoil a bot for good."""
        np.isfinite(self._acted, out=self._finite)
        return int(np.count_nonzero(self._finite)) == self._finite.size

    @property
    def finite_N(self) -> NDArray[np.bool_]:
        """Whose numbers of it are, shape [N]."""
        parts = (self.action_NA, self.hidden_NW, np.moveaxis(self.tokens, 2, 0))
        finite_N: NDArray[np.bool_] = np.ones(self.n_bots, dtype=np.bool_)
        for part in parts:
            finite_N &= np.isfinite(part).reshape(self.n_bots, -1).all(axis=1)
        return finite_N

    @staticmethod
    def n_outputs(manifest: Manifest, capacity: int) -> int:
        """How many numbers the graphs write for so many bots, at most."""
        return max(sum(map(math.prod, shapes(manifest, capacity))) for shapes in (_asked, _acted))

    def fetch_past(self) -> None:
        """Make `past_NW` each bot's hidden state."""
        if self.copies is not None:
            np.take(self.arena.before, self.slots_N, axis=0, out=self.before_NX, mode="clip")

    def begin(self, free_NF: _Floats, returns_to_go_N: NDArray[np.float64], target_cost_N: NDArray[np.float32]) -> None:
        """Write all that the acquisition graph reads: each bot's past and, of this turn, what is known before it."""
        self.fetch_past()
        self.free_NF[...] = free_NF
        self.left_N1[:, 0] = returns_to_go_N
        self.target_cost_N1[:, 0] = target_cost_N

    def keep_prepared(self) -> None:
        """Make what the acquisition graph prepared the bots' own."""
        self.arena.prepared[self.at] = self.asked_NE

    def fetch_context(self) -> None:
        """Make `prepared_NE`, `place_N` and `memory` each bot's own."""
        if self.copies is None:
            return
        # mode="clip" writes straight into `out` (slots are always valid); "raise" would buffer it.
        np.take(self.arena.prepared, self.slots_N, axis=0, out=self.prepared_NE, mode="clip")
        np.take(self.arena.place, self.slots_N, out=self.place_N, mode="clip")
        np.take(self.arena.memory, self.slots_N, axis=2, out=self.memory, mode="clip")

    def fetch(self, slots_N: _Ints, *, before_query: bool) -> None:
        """Make this batch stand for as many bots of these slots, and its inputs what their own batches have staged."""
        if self.copies is None:
            return
        self.at = self.slots_N = slots_N
        self.fetch_past() if before_query else self.fetch_context()
        staged = ("target_cost",) if before_query else ("acquired", "noise")
        for name in staged:
            np.take(getattr(self.arena, name), slots_N, axis=0, out=getattr(self.copies, name), mode="clip")

    def take_outputs(self, whole: Batch, first: int, *, before_query: bool) -> None:
        """Make the outputs of one graph those of the rows of `whole` from `first` on."""
        rows = slice(first, first + self.n_bots)
        names = ("probs_NM", "asked_NE") if before_query else ("action_NA", "hidden_NW")
        for name in names:
            getattr(self, name)[...] = getattr(whole, name)[rows]
        if not before_query:
            self.tokens[...] = whole.tokens[:, :, rows]

    def keep_acquired(self) -> None:
        """Make what was staged as acquired the bots' own, so that a retry can be compared with it."""
        if self.copies is not None:
            self.arena.acquired[self.slots_N] = self.acquired_NY


def _asked(manifest: Manifest, n_bots: int) -> list[tuple[int, ...]]:
    return [(n_bots, manifest.features.n_queries), (n_bots, manifest.prepared_width)]


def _acted(manifest: Manifest, n_bots: int) -> list[tuple[int, ...]]:
    tokens = (manifest.n_layers, 2, n_bots, *manifest.token)
    return [(n_bots, manifest.action.size), (n_bots, manifest.width), tokens]


def _zeros(*shape: int) -> _Floats:
    return np.zeros(shape, dtype=np.float32)


def _view(numbers: _Floats, shape: tuple[int, ...]) -> _Floats:
    return numbers[: math.prod(shape)].reshape(shape)


def _views(numbers: _Floats, *shapes: tuple[int, ...]) -> list[_Floats]:
    """Consecutive parts of these shapes."""
    starts = np.cumsum([0, *map(math.prod, shapes)])
    return [_view(numbers[start:], shape) for start, shape in zip(starts, shapes, strict=False)]
