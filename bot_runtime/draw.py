"""A draw: what N bots ask for in one frame, before anyone has answered.

This module knows nothing about handles, turns or messages. The server's bots and an engine's own head draw by the same
function, so that they ask the same questions.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from bot_runtime.company import Means
from bot_runtime.fallback import non_finite
from bot_runtime.turns import Queries

__all__ = ["Asker", "draw", "finite_rows"]


class Asker(Protocol):
    """Whatever runs the acquisition graph."""

    def query_probs(self, batch: Batch) -> None:
        """From `before_NX` and `target_cost_N1` to `probs_NM` and `asked_NE`."""


def draw(
    batch: Batch,
    frame: int,
    noise_NX: NDArray[np.float32],
    means: Means,
    frame_budget_us: float | None,
    infer_us: float,
) -> Queries:
    """Of a batch that the graph was run over: sample by the first M numbers of its noise, and allocate."""
    probs_NM = batch.probs_NM.copy()
    query_NM = noise_NX[:, : probs_NM.shape[1]] < probs_NM
    asks_N, reasons_N = finite_rows(probs_NM), None
    if asks_N is not None:
        query_NM &= asks_N[:, None]
        reasons_N = non_finite(asks_N)
    query_NM, cost_us_N = means.fit(probs_NM, query_NM, frame_budget_us)
    for array in (query_NM, cost_us_N, probs_NM):
        array.setflags(write=False)
    return Queries(frame, query_NM, cost_us_N, probs_NM, infer_us, reasons_N)


def finite_rows(probs_NM: NDArray[np.float32]) -> NDArray[np.bool_] | None:
    """Whose means are finite, [N]; None where everyone's are."""
    finite_NM = np.isfinite(probs_NM)
    if np.count_nonzero(finite_NM) == finite_NM.size:
        return None
    asks_N: NDArray[np.bool_] = np.logical_and.reduce(finite_NM, axis=1)
    return asks_N
