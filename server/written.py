"""What the bots answer, as messages.

This module knows nothing about requests, connections or bytes.
"""

from __future__ import annotations

from typing import overload

import numpy as np
from numpy.typing import NDArray

from bot_runtime import turns
from protocol import arrays
from protocol.codec import Format
from protocol.messages import Actions, Queries

__all__ = ["written"]


@overload
def written(result: turns.Queries, form: Format, hidden_NW: None = None) -> Queries: ...


@overload
def written(
    result: turns.Queries | turns.Actions, form: Format, hidden_NW: NDArray[np.float32] | None = None
) -> Queries | Actions: ...


def written(
    result: turns.Queries | turns.Actions, form: Format, hidden_NW: NDArray[np.float32] | None = None
) -> Queries | Actions:
    """The message of this result, its blobs written for `form`; with the bots' hidden state where it was asked for."""
    if isinstance(result, turns.Actions):
        return Actions(
            frame=result.frame,
            actions=arrays.pack_floats(result.action_NA, form),
            reasons=result.reasons_N.tolist(),
            infer_us=result.infer_us,
            turns=result.turns_N.tolist(),
            hidden=None if hidden_NW is None else arrays.pack_floats(hidden_NW, form),
        )
    return Queries(
        frame=result.frame,
        queries=arrays.pack_bits(result.query_NM, form),
        cost_us=result.cost_us_N.tolist(),
        infer_us=result.infer_us,
        reasons=None if result.reasons_N is None else result.reasons_N.tolist(),
    )
