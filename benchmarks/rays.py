"""Do frames of real rays take longer than their budget, once their costs are measured? Each one that does is counted.

This module knows nothing about servers or bundles. The bots stand anywhere on a map in pybullet and sample queries from
random probabilities; `allocate` cuts them to the frame's budget by the costs as measured so far, starting from a table
of another engine; the rays are cast, the frame is timed, and the costs learn from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from benchmarks.clocks import CLOCKS, Clock
from bot_runtime.budget import allocate
from bot_runtime.costs import Costs, Report
from game.layout import draw_layout
from game.rays import RAYS, cost_model, load_costs
from game.terrain import load_map
from game.world import World

__all__ = ["RayTally", "cast_frames", "play"]

SHARES = (0.05, 0.1, 0.2, 0.4)  # of what all rays of all bots would take by the shipped measurement


@dataclass
class RayTally:
    """What came of the frames after calibration. Those in which nothing fitted are not among `frames`."""

    clock: Clock
    frames: int = 0
    cut_frames: int = 0  # asked for less than was sampled: the budget was in force
    over: int = 0  # took longer than the budget
    cut_over: int = 0  # of those cut
    violations: int = 0  # were predicted to cost more than the budget
    used: float = 0.0  # sum of measured shares of the budget
    worst: float = 0.0  # measured, as a multiple of the budget

    @property
    def over_pct(self) -> float:
        """How many frames took longer than their budget, in percent."""
        return 100.0 * self.over / max(self.frames, 1)

    def count(self, measured_us: float, budget_us: float, *, cut: bool) -> None:
        """One more frame."""
        is_over = measured_us > budget_us
        self.frames += 1
        self.cut_frames += cut
        self.over += is_over
        self.cut_over += cut and is_over
        self.used += measured_us / budget_us
        self.worst = max(self.worst, measured_us / budget_us)


def play(
    frames: int, calibration: int, bots: int, clock: Clock, seed: int, cast_us: Callable[[np.ndarray], float]
) -> tuple[RayTally, Report]:
    """Play `calibration` frames and then `frames` that count; `cast_us` acquires a query [N, M] and times it."""
    random, tally = np.random.default_rng(seed), RayTally(clock)
    costs, full_us = Costs(cost_model(load_costs("godot"))), bots * cost_model(load_costs("pybullet")).full_us
    for frame in range(calibration + frames):
        level = random.random((bots, 1)) ** 2  # some bots want much and some little, of some ranges more
        probs = random.random((bots, len(RAYS))) * level * np.repeat(random.random(6), len(RAYS) // 6)
        sampled = random.random(probs.shape) < probs
        budget_us = full_us * float(random.choice(SHARES))
        query = allocate(probs, sampled, costs.costs_M, costs.call_us, np.inf, budget_us)
        predicted_us = float(costs.model.query_cost_us(query).sum())
        measured_us = cast_us(query)
        if frame >= calibration:
            tally.violations += predicted_us > budget_us
            if query.any():
                tally.count(measured_us, budget_us, cut=not np.array_equal(query, sampled))
        costs.observe(query, measured_us)
    return tally, costs.report()


@contextmanager
def cast_frames(map_name: str, clock: Clock, seed: int) -> Iterator[Callable[[np.ndarray], float]]:
    """Real rays: each bot at a place of its own on the map, one batch of pybullet a bot, µs of all of them together."""
    terrain, random, now = load_map(map_name), np.random.default_rng([seed, 1]), CLOCKS[clock]
    half_x, half_y = terrain.size_m[0] / 2 - 1, terrain.size_m[1] / 2 - 1
    world = World(terrain)
    world.place(draw_layout(terrain, random))

    def cast_us(query_NM: np.ndarray) -> float:
        spent_ns = 0
        for query_M in query_NM[query_NM.any(axis=1)]:
            world.character.place(
                random.uniform(-half_x, half_x), random.uniform(-half_y, half_y), random.uniform(-3, 3)
            )
            begun = now()
            world.cast(query_M)
            spent_ns += now() - begun
        return spent_ns / 1e3

    try:
        yield cast_us
    finally:
        world.close()
