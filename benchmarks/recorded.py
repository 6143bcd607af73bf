"""Turns on recorded frames, the same ones whatever carries them: in process, or over a client's transport.

This module knows nothing about what is measured, or in which order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.clocks import CLOCKS, Clock
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden
from protocol.client import BotClient
from protocol.features import FeatureTable

__all__ = ["RecordedFrames", "Timed", "in_process", "over"]

Timed = tuple[float, float]
"""µs of a turn's two halves, without what the engine does between them, and of the model in it."""


class RecordedFrames:
    """The golden file's frames, over and over; bot n is n frames ahead, so that a batch is not N equal rows."""

    def __init__(self, table: FeatureTable, golden: Golden, n_bots: int) -> None:
        self._table = table
        self._free_TF, self._costly_TD = golden["free"], golden["costly"]
        self._n_bots = n_bots

    def free(self, frame: int) -> NDArray[np.float32]:
        """Free numbers [N, F] of a frame."""
        return self._free_TF[self._rows(frame)]

    def costly(self, frame: int) -> NDArray[np.float32]:
        """All costly numbers [N, D] of a frame."""
        return self._costly_TD[self._rows(frame)]

    def known(self, frame: int, query_NM: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Costly numbers [N, D] of a frame, zero where they were not asked for."""
        return np.where(query_NM[:, self._table.owner], self.costly(frame), np.float32(0.0))

    def _rows(self, frame: int) -> NDArray[np.int64]:
        return (frame + np.arange(self._n_bots)) % len(self._free_TF)


def in_process(bundle: Bundle, golden: Golden, n_bots: int, clock: Clock = "wall") -> Callable[[], Timed]:
    """A call that plays the next turn of `n_bots` new bots, both graphs, without a wire."""
    bots = Bots(bundle, max_bots=n_bots)
    handles = bots.start(n_bots)

    def ask(frame: int, free_NF: NDArray[np.float32]) -> tuple[NDArray[np.bool_], float]:
        queries = bots.request_queries(handles, frame, free_NF)
        return queries.query_NM, queries.infer_us

    def act(frame: int, query_NM: NDArray[np.bool_], costly_ND: NDArray[np.float32]) -> float:
        return bots.submit_features(handles, frame, query_NM, costly_ND).infer_us

    return _turns(RecordedFrames(bundle.manifest.features, golden, n_bots), ask, act, CLOCKS[clock])


def over(client: BotClient, bundle: Bundle, golden: Golden, n_bots: int, clock: Clock = "wall") -> Callable[[], Timed]:
    """A call that plays the next turn of `n_bots` new bots of this client, in two round trips."""
    client.hello()
    handles = client.start(n_bots)

    def ask(frame: int, free_NF: NDArray[np.float32]) -> tuple[NDArray[np.bool_], float]:
        queries = client.query(handles, frame, free_NF)
        return queries.queries, queries.infer_us

    def act(frame: int, query_NM: NDArray[np.bool_], costly_ND: NDArray[np.float32]) -> float:
        return client.act(handles, frame, query_NM, costly_ND).infer_us

    return _turns(RecordedFrames(bundle.manifest.features, golden, n_bots), ask, act, CLOCKS[clock])


def _turns(
    frames: RecordedFrames,
    ask: Callable[[int, NDArray[np.float32]], tuple[NDArray[np.bool_], float]],
    act: Callable[[int, NDArray[np.bool_], NDArray[np.float32]], float],
    now_ns: Callable[[], int],
) -> Callable[[], Timed]:
    frame = 0

    def turn() -> Timed:
        nonlocal frame
        free_NF = frames.free(frame)
        begun = now_ns()
        query_NM, asked_us = ask(frame, free_NF)
        told = now_ns()
        known_ND = frames.known(frame, query_NM)
        sent = now_ns()
        acted_us = act(frame, query_NM, known_ND)
        whole_us = (now_ns() - sent + told - begun) / 1e3
        frame += 1
        return whole_us, asked_us + acted_us

    return turn
