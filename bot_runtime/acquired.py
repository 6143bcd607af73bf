"""Acquired: what an engine sends in a turn's second half, checked: values, failures, and how long acquiring took.

This module knows nothing about turns, contexts or policies.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.costs import MAX_ACQUIRE_US

__all__ = ["UNMEASURED", "Acquired"]

UNMEASURED = np.zeros(0)
_Bools = NDArray[np.bool_]


class Acquired(Struct, frozen=True, eq=False):
    """What came [N, M], what is known of it [N, M] (what failed is not), its values [N, D], µs [1] or [0] if unsaid."""

    acquired_NM: _Bools
    known_NM: _Bools
    costly_ND: NDArray[np.float32]
    measured_us: NDArray[np.float64]

    @classmethod
    def checked(
        cls,
        checks: inputs.FeatureChecks,
        handles_N: NDArray[np.int64],
        query_NM: _Bools,
        acquired_NM: _Bools,
        costly_ND: NDArray[np.float32],
        failed_NM: _Bools | None,
        acquire_us: float | None,
        out_ND: NDArray[np.float32],
    ) -> Self:
        """Values go to `out_ND`. Raises BadShape, UnrequestedFeature, MissingFeature, NonFinite, OutOfRange."""
        known_NM = checks.costly(acquired_NM, costly_ND, failed_NM, query_NM, handles_N, out_ND)
        measured_us = UNMEASURED
        if acquire_us is not None:
            measured_us = inputs.per_bot("acquire_us", (acquire_us,), 1, 0.0, MAX_ACQUIRE_US)
        return cls(acquired_NM, known_NM, out_ND, measured_us)

    @property
    def content(self) -> tuple[NDArray[Any], ...]:
        """What a retry must equal."""
        return self.costly_ND, self.known_NM, self.measured_us
