"""The acquisition heat map: how probable a query of each feature is at each timestep, over many episodes.

This module knows nothing about bundles or environments.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

__all__ = ["HeatMap", "HeatSums"]

_ROOM = 256  # timesteps before the sums have to grow


class HeatMap(NamedTuple):
    """`probs_TM`: mean query probability over the episodes alive at timestep t, of which there are `alive_T`.

    `costs_M` is the cost of each feature in µs, `names` its name.
    """

    probs_TM: NDArray[np.float32]
    alive_T: NDArray[np.int64]
    costs_M: NDArray[np.float64]
    names: tuple[str, ...]

    @property
    def cost_pct(self) -> float:
        """What was asked for on average, % of the full cost: the soft cost of the evaluation that made this."""
        cost_T = self.probs_TM.astype(np.float64) @ self.costs_M / self.costs_M.sum()
        return 100.0 * float(cost_T @ self.alive_T / self.alive_T.sum())

    def write(self, path: Path) -> None:
        """Write an .npz with these four arrays, at exactly `path`."""
        with path.open("wb") as file:
            np.savez_compressed(
                file,
                probs_TM=self.probs_TM,
                alive_T=self.alive_T,
                costs_M=self.costs_M,
                names=np.array(self.names, dtype=np.str_),
            )

    @classmethod
    def read(cls, path: Path) -> HeatMap:
        """Read what `write` wrote. Raises ValueError for anything else."""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = [data[name] for name in cls._fields]
        except (KeyError, TypeError, EOFError, OSError, ValueError, BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} is no heat map, expected an .npz with {list(cls._fields)}: {error}") from error
        probs_TM, alive_T, costs_M, names = arrays
        if probs_TM.shape != (alive_T.size, costs_M.size) or names.shape != costs_M.shape:
            got = [list(array.shape) for array in arrays]
            raise ValueError(f"{path} has shapes {got}, expected [[T, M], [T], [M], [M]]")
        return cls(probs_TM, alive_T, costs_M, tuple(str(name) for name in names))


class HeatSums:
    """Sums of query probabilities by timestep. They grow with the longest episode."""

    def __init__(self, n_queries: int) -> None:
        self._sums_TM = np.zeros((_ROOM, n_queries))
        self._alive_T = np.zeros(_ROOM, dtype=np.int64)

    def add(self, timesteps_N: NDArray[np.int64], probs_NM: NDArray[np.floating]) -> None:
        """Count these bots' probabilities [N, M] at the timestep that each of them is in [N]."""
        self._grow(int(timesteps_N.max(initial=-1)) + 1)
        np.add.at(self._sums_TM, timesteps_N, probs_NM)
        np.add.at(self._alive_T, timesteps_N, 1)

    def merge(self, other: HeatSums) -> None:
        """Count what `other` counted too."""
        length = other._alive_T.size
        self._grow(length)
        self._sums_TM[:length] += other._sums_TM
        self._alive_T[:length] += other._alive_T

    def mean(self, costs_M: NDArray[np.float64], names: tuple[str, ...]) -> HeatMap:
        """The heat map of all that was counted."""
        length = int((self._alive_T > 0).sum())  # episodes begin at 0, so the counts never rise
        alive_T = self._alive_T[:length].copy()
        probs_TM = (self._sums_TM[:length] / alive_T[:, None]).astype(np.float32)
        return HeatMap(probs_TM, alive_T, np.asarray(costs_M, dtype=np.float64), names)

    def _grow(self, length: int) -> None:
        while self._alive_T.size < length:
            self._sums_TM = np.concatenate([self._sums_TM, np.zeros_like(self._sums_TM)])
            self._alive_T = np.concatenate([self._alive_T, np.zeros_like(self._alive_T)])
