"""What one episode draws from its seed: trip, standing bridges and pools.

This module knows nothing about pybullet or players.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from game.grid import Grid
from game.terrain import Hazard, MapError, PoolZone, Rect, River, Terrain, overlaps

__all__ = ["Layout", "draw_layout", "open_stretches"]

_DRAWS = 200
_CLEAR_OF_TRIP_M = 3.0
_BETWEEN_POOLS_M = 3.0
_SHORTEST_TRIP_M = 5.0
_BESIDE_BLOCK_M = 1.0
_SAFE_M = 0.9


@dataclass(frozen=True)
class Layout:
    """One episode's world on top of its map. `bridges[r][s]` tells whether slot s of river r has a bridge."""

    start: tuple[float, float]
    start_yaw: float
    goal: tuple[float, float]
    bridges: tuple[tuple[bool, ...], ...]
    pools: tuple[Hazard, ...]
    deadly: tuple[Rect, ...]
    """Every rectangle that kills: fixed hazards, rivers less their standing bridges, pools."""


def draw_layout(terrain: Terrain, rng: np.random.Generator) -> Layout:
    """A layout whose goal can be reached on foot; the same generator state gives the same layout.

    Raises MapError when no draw of many is reachable, which is the map's fault.
    """
    grid = Grid(terrain)
    for _ in range(_DRAWS):
        layout = _draw(terrain, rng)
        if layout is not None and _reachable(terrain, grid, layout):
            return layout
    raise MapError(f"map {terrain.name}: in {_DRAWS} draws no goal could be reached")


def open_stretches(river: River, crossable: tuple[bool, ...]) -> list[Rect]:
    """The parts of a river that are left when the slots marked in `crossable` are taken out."""
    x0, y0, x1, y1 = river.rect
    along_y = all(slot[0] == x0 and slot[2] == x1 for slot in river.slots)
    gaps = sorted(
        (slot[1], slot[3]) if along_y else (slot[0], slot[2])
        for slot, open_ in zip(river.slots, crossable, strict=True)
        if open_
    )
    stretches: list[Rect] = []
    begin, end = (y0, y1) if along_y else (x0, x1)
    for low, high in [*gaps, (end, end)]:
        if low > begin:
            stretches.append((x0, begin, x1, low) if along_y else (begin, y0, low, y1))
        begin = max(begin, high)
    return stretches


def _draw(terrain: Terrain, rng: np.random.Generator) -> Layout | None:
    trip = terrain.trips[rng.integers(len(terrain.trips))]
    start, goal = _point(trip.start, rng), _point(trip.goal, rng)
    if math.dist(start, goal) < _SHORTEST_TRIP_M:
        return None
    yaw = math.atan2(goal[1] - start[1], goal[0] - start[0]) + rng.uniform(-1.0, 1.0)
    bridges = []
    for river in terrain.rivers:
        standing = rng.choice(len(river.slots), size=river.standing, replace=False)
        bridges.append(tuple(bool(slot in standing) for slot in range(len(river.slots))))
    pools: list[Hazard] = []
    blocks = [block.rect for block in (*terrain.walls, *terrain.ledges)]
    for zone in terrain.pools:
        for _ in range(zone.count):
            pool = _pool(zone, rng)
            if any(overlaps(pool.rect, other.rect, _BETWEEN_POOLS_M) for other in pools):
                continue  # fewer pools rather than a wall of them
            if any(overlaps(pool.rect, block, _BESIDE_BLOCK_M) for block in blocks):
                continue  # nobody sees what lies half under a wall
            if any(_near(pool.rect, point, _CLEAR_OF_TRIP_M) for point in (start, goal)):
                continue
            pools.append(pool)
    deadly = [hazard.rect for hazard in terrain.hazards] + [pool.rect for pool in pools]
    for river, standing_slots in zip(terrain.rivers, bridges, strict=True):
        deadly += open_stretches(river, standing_slots)
    return Layout(start, math.remainder(yaw, math.tau), goal, tuple(bridges), tuple(pools), tuple(deadly))


def _pool(zone: PoolZone, rng: np.random.Generator) -> Hazard:
    """Whole metres, so that the planner's cells see it as it is."""
    x0, y0, x1, y1 = (round(edge) for edge in zone.zone)
    x = int(rng.integers(x0, x1 - zone.size_m, endpoint=True))
    y = int(rng.integers(y0, y1 - zone.size_m, endpoint=True))
    kind = "lava" if rng.random() < 0.5 else "water"
    return Hazard(kind, (x, y, x + zone.size_m, y + zone.size_m))


def _point(rect: Rect, rng: np.random.Generator) -> tuple[float, float]:
    return float(rng.uniform(rect[0], rect[2])), float(rng.uniform(rect[1], rect[3]))


def _near(rect: Rect, point: tuple[float, float], margin_m: float) -> bool:
    return overlaps(rect, (*point, *point), margin_m)


def _reachable(terrain: Terrain, grid: Grid, layout: Layout) -> bool:
    costs_HW = grid.empty()
    costs_HW[grid.inside(wall.rect for wall in terrain.walls)] = np.inf
    costs_HW[grid.inside(layout.deadly, _SAFE_M)] = np.inf
    costs: list[float] = costs_HW.ravel().tolist()
    start, goal = grid.cell(*layout.start), grid.cell(*layout.goal)
    return math.isfinite(grid.cost_to_go(costs, goal, start)[start])
