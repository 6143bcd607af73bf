"""What acquiring really costs: an engine's measured µs, turned into the costs that its bots' budgets are kept by.

This module knows nothing about connections or how anything was measured. An engine says how many µs acquiring took for
all bots of one message. From that and from what was acquired come:

- *A shape.* measured = call x bots that acquired anything + sum over groups of factor x declared µs acquired.
  Features of one declared cost are a group, as rays of one range are. The call and the factors minimise the squared
  error as a share of what was declared, each frame counting 0.2 % less than the one after it; within bounds, by a
  sweep of projected Gauss-Seidel a frame. They are drawn towards what was declared, times the one factor that fits
  best, and the more the noisier the measurements are (a Bayesian ridge). A measurement counts as no more than twice
  and no less than half of what was expected (Winsorised: Huber, *Robust Statistics*, 1981, section 1.3). So a stalled
  frame hardly moves the shape, and a wrong declaration is left behind in a few frames.
- *A margin* on top that `quantile` of the frames stay within. Its logarithm grows by quantile x _STEP after a frame
  that cost more than predicted, and shrinks by (1 - quantile) x _STEP after any other: the quantile tracking of
  Angelopoulos, Candès and Tibshirani (*Conformal PID Control for Time Series Prediction*, 2023; after Gibbs and Candès,
  2021). Nothing is assumed of the measurements. After T frames, E of them above, that logarithm is at least
  (E - (1 - quantile) T) x _STEP and at most log(within), so E <= (1 - quantile) T + log(within) / _STEP, unless frames
  cost more than the bounds below allow. One frame, however long, moves the margin by 5 %. It falls slowly, by as much
  in 500 frames: what is kept is a promise to engines, and what is lost is a little of the budget.

Whatever is measured, a cost stays between `within` times less and `within` times more than was declared. What was
declared free stays free; but a call may cost up to `within` times a mean feature. So an engine that reports nonsense
harms its own bots' budgets, and those by no more than that.

    curl http://127.0.0.1:8000/v1/costs | python -m bot_runtime.costs
"""

from __future__ import annotations

import math
import sys
from operator import mul

import msgspec
import numpy as np
from numpy.typing import NDArray

from protocol.features import CostModel

__all__ = ["MAX_ACQUIRE_US", "QUANTILE", "Costs", "Report", "Row", "as_text"]

QUANTILE = 0.998
MAX_ACQUIRE_US = 1e9
_MAX_GROUPS = 12
_MEMORY = 0.998  # weight of a frame against the one after it
_SPREAD = 0.25  # how much costs are believed to differ from what was declared times the common factor
_STEP = 0.05  # of the logarithm of the margin
_LARGEST_US = 1e6  # that a cost model may hold


class Row(msgspec.Struct, frozen=True):
    """The call, or a group of features: mean µs declared, estimated and charged to budgets; how often acquired."""

    group: str
    declared_us: float
    estimated_us: float
    charged_us: float
    n: int


class Report(msgspec.Struct, frozen=True):
    """What one engine measured: how many frames, how many of them cost more than had been predicted, and the costs."""

    quantile: float
    frames: int
    over: int
    rows: tuple[Row, ...]


class Costs:
    """The costs of one engine, as declared until it reports. Memory and time a frame do not grow.

    `costs_M`, `call_us` and `full_us` are what budgets are kept by. `n_frames` measurements came; `n_over` of them were
    more than had been predicted.
    """

    def __init__(self, declared: CostModel, *, quantile: float = QUANTILE, within: float = 32.0) -> None:
        """Raises ValueError unless `quantile` is between 0 and 1, and `within` above 1."""
        if not 0.0 < quantile < 1.0 or not within > 1.0:
            raise ValueError(f"quantile is {quantile} and within {within}, expected between 0 and 1, and more than 1")
        self.declared, self.quantile = declared, quantile
        self.costs_M, self.call_us = declared.costs_us, declared.call_us
        self.n_frames = self.n_over = 0
        self._labels, self._group_M = _groups(declared.costs_us)
        self._counts_M = np.zeros(self._group_M.size)
        self._calls = 0
        self._declared_MG = declared.costs_us[:, None] * (self._group_M[:, None] == np.arange(len(self._labels)))
        self._unit_us = declared.call_us or float(declared.costs_us.sum()) / max(self._group_M.size, 1)
        self._belief = [1.0 if declared.call_us else 0.0] + [1.0] * len(self._labels)  # the call in units, then factors
        self._least = [number / within for number in self._belief]
        largest_us = [self._unit_us, *self._declared_MG.max(axis=0, initial=0.0).tolist()]
        self._most = [min(within, _LARGEST_US / max(us, 1.0)) for us in largest_us]
        self._shape, self._charged = list(self._belief), list(self._belief)
        self._normal_PP = np.zeros((len(self._shape), len(self._shape)))
        self._moments_P = np.zeros(len(self._shape))
        self._sums = [0.0, 0.0, 0.0, 0.0]
        self._within, self._log_margin = within, 0.0

    def observe(self, acquired_NM: NDArray[np.bool_], acquire_us: float) -> float | None:
        """Acquiring this took so many µs; returns how many had been predicted.

        Where nothing was acquired, or the number is none, nothing is learned, and it returns None.
        """
        counts_M, calls = np.ones(len(acquired_NM)) @ acquired_NM, int(np.count_nonzero(acquired_NM.any(axis=1)))
        parts: list[float] = [calls * self._unit_us, *(counts_M @ self._declared_MG).tolist()]
        scale_us = sum(parts)
        if not (scale_us > 0.0 and 0.0 <= acquire_us <= MAX_ACQUIRE_US):
            return None
        expected_us = max(_dot(parts, self._shape), scale_us / self._within)
        predicted_us = _dot(parts, self._charged)
        is_over = acquire_us > predicted_us
        self.n_frames += 1
        self.n_over += is_over
        self._counts_M += counts_M
        self._calls += calls
        step = self.quantile if is_over else self.quantile - 1.0
        bound = math.log(self._within)
        self._log_margin = min(max(self._log_margin + _STEP * step, -bound), bound)
        self._fit(parts, scale_us, min(max(acquire_us, expected_us / 2.0), expected_us * 2.0))
        self._charge()
        return predicted_us

    def _fit(self, parts: list[float], scale_us: float, measured_us: float) -> None:
        row_P, measured = np.array(parts) / scale_us, measured_us / scale_us
        declared, missed = _dot(parts, self._belief) / scale_us, measured - _dot(parts, self._shape) / scale_us
        new = (1.0, declared * measured, declared**2, missed**2)
        self._sums = [_MEMORY * old + number for old, number in zip(self._sums, new, strict=True)]
        frames, cross, square, noise = self._sums
        common = (cross + 1e-9) / (square + 1e-9)
        belief = max(noise / frames / (_SPREAD * common) ** 2, 1e-6)  # in frames
        self._normal_PP *= _MEMORY
        self._normal_PP += row_P[:, None] * row_P
        self._moments_P *= _MEMORY
        self._moments_P += row_P * measured
        rows, moments, shape = self._normal_PP.tolist(), self._moments_P.tolist(), self._shape
        for i, row in enumerate(rows):  # one sweep a frame: the solution moves little from frame to frame
            believed = moments[i] + belief * common * self._belief[i]
            best = (believed + row[i] * shape[i] - _dot(row, shape)) / (row[i] + belief)
            shape[i] = min(max(best, self._least[i]), self._most[i])

    def _charge(self) -> None:
        margin = math.exp(self._log_margin)
        bounds = zip(self._shape, self._least, self._most, strict=True)
        self._charged = [min(max(number * margin, least), most) for number, least, most in bounds]
        # A factor within its bounds may round past the largest cost there is.
        self.call_us = min(self._charged[0] * self._unit_us, _LARGEST_US)
        charged_M = np.array(self._charged[1:])[self._group_M] * self.declared.costs_us
        self.costs_M = np.minimum(charged_M, _LARGEST_US)

    @property
    def full_us(self) -> float:
        """Cost in µs of asking for everything."""
        return self.call_us + float(self.costs_M.sum())

    @property
    def model(self) -> CostModel:
        """What is charged, as a cost model."""
        return CostModel(self.call_us, tuple(self.costs_M.tolist()))

    def report(self) -> Report:
        """What there is to see: the call first, then the groups from the cheapest."""
        rows = [Row("call", self.declared.call_us, self._shape[0] * self._unit_us, self.call_us, self._calls)]
        for index, label in enumerate(self._labels):
            of_group_M = self._group_M == index
            declared_us = float(self.declared.costs_us[of_group_M].mean())
            n = int(self._counts_M[of_group_M].sum())
            shape, charged = self._shape[1 + index], self._charged[1 + index]
            rows.append(Row(label, declared_us, declared_us * shape, declared_us * charged, n))
        return Report(self.quantile, self.n_frames, self.n_over, tuple(rows))


def as_text(report: Report) -> str:
    """A report as a table of text."""
    lines = [f"{'':16}{'declared µs':>13}{'estimated µs':>14}{'charged µs':>12}{'times':>12}"]
    for row in report.rows:
        lines.append(f"{row.group:16}{row.declared_us:13.3f}{row.estimated_us:14.3f}{row.charged_us:12.3f}{row.n:12,}")
    over_pct = 100.0 * report.over / max(report.frames, 1)
    lines.append(
        f"{report.frames:,} frames measured, {report.over:,} ({over_pct:.2f} %) above what had been predicted; "
        f"charged so that {100.0 * (1.0 - report.quantile):g} % are"
    )
    return "\n".join(lines)


def _groups(costs_M: NDArray[np.float64]) -> tuple[list[str], NDArray[np.int64]]:
    """A label of each group, and the group of each feature: one a declared cost, or of neighbouring costs if many."""
    distinct, place_M = np.unique(costs_M, return_inverse=True)
    parts = np.array_split(distinct, min(distinct.size, _MAX_GROUPS)) if distinct.size else []
    labels = [f"{part[0]:g} µs" if part.size == 1 else f"{part[0]:g} to {part[-1]:g} µs" for part in parts]
    group_of = np.repeat(np.arange(len(parts)), [part.size for part in parts])
    return labels, group_of[place_M].astype(np.int64)


def _dot(left: list[float], right: list[float]) -> float:
    return sum(map(mul, left, right), 0.0)


def main() -> None:
    """Show the reports that a server's /v1/costs answers, read from standard input."""
    try:
        reports = msgspec.json.decode(sys.stdin.buffer.read(), type=list[Report])
    except msgspec.DecodeError as error:
        sys.exit(f"this is not the JSON of /v1/costs: {error}")
    print("\n\n".join(as_text(report) for report in reports) or "no engine is connected")


if __name__ == "__main__":
    main()
