"""Measuring what rays cost on this machine: µs per call and per ray by range.

This module knows nothing about episodes, rewards or players.
"""

from __future__ import annotations

import platform
import time

import numpy as np
from numpy.typing import NDArray

from game.layout import draw_layout
from game.rays import RANGES_M, RAYS, RayCosts
from game.terrain import Terrain
from game.world import World

__all__ = ["calibrate", "fit"]

_BATCHES = (1, 2, 4, 8, 16)
_LEAST_US = 0.01
"""A cost of 0 would make a ray a free feature."""


def calibrate(terrain: Terrain, *, poses: int = 60, repeats: int = 5, seed: int = 0) -> RayCosts:
    """Time `World.cast`, all of it, for batches of one range each, from random poses of the map, and fit the costs.

    The least of `repeats` timings counts for each pose: what else ran on the machine is not the rays' cost.
    """
    rng = np.random.default_rng(seed)
    world = World(terrain)
    world.place(draw_layout(terrain, rng))
    half_x, half_y = terrain.size_m[0] / 2 - 1, terrain.size_m[1] / 2 - 1
    counts, times_us = [], []
    for _ in range(poses):
        world.character.place(rng.uniform(-half_x, half_x), rng.uniform(-half_y, half_y), rng.uniform(-3, 3))
        for range_m in RANGES_M:
            of_range = np.array([i for i, ray in enumerate(RAYS) if ray.range_m == range_m])
            for batch in _BATCHES:
                query_M = np.zeros(len(RAYS), dtype=bool)
                query_M[rng.choice(of_range, size=min(batch, len(of_range)), replace=False)] = True
                counts.append([int(query_M[of_range].sum()) * (range_m == other) for other in RANGES_M])
                times_us.append(min(_cast_us(world, query_M) for _ in range(repeats)))
    world.close()
    call_us, range_us = fit(np.array(counts, dtype=np.float64), np.array(times_us))
    source = f"game.rays --calibrate: pybullet, {platform.machine()}, {poses * len(RANGES_M) * len(_BATCHES)} batches"
    return RayCosts(source, call_us, dict(zip(RANGES_M, range_us, strict=True)))


def fit(counts_BR: NDArray[np.float64], times_us_B: NDArray[np.float64]) -> tuple[float, list[float]]:
    """Least squares of time = call + sum over ranges of count x cost; B batches, R ranges. No cost is below 0.01 µs."""
    design_BC = np.column_stack([np.ones(len(counts_BR)), counts_BR])
    solution_C, *_ = np.linalg.lstsq(design_BC, times_us_B, rcond=None)
    costs_C = np.maximum(solution_C, _LEAST_US).round(3)
    return float(costs_C[0]), [float(us) for us in costs_C[1:]]


def _cast_us(world: World, query_M: NDArray[np.bool_]) -> float:
    begun = time.perf_counter_ns()
    world.cast(query_M)
    return (time.perf_counter_ns() - begun) / 1000.0
