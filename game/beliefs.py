"""What a scripted player believes about the episode it is in, and what walking costs under that belief.

This module knows nothing about pybullet or actions.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from game.character import Character
from game.grid import Grid
from game.layout import Layout, open_stretches
from game.skills import Skill
from game.terrain import Rect, Terrain

__all__ = ["Beliefs"]

_VIEW_RAD = math.radians(75.0)
_DOUBT_M = 12.0
"""An unseen crossing is planned over as if it were this much longer."""
_DOUBTFUL_M = 5.0
_LEVEL_M = 0.3
"""Feet higher than this stand on a ledge, with eyes so high that rays of 5 and 10 m end above the ground."""
_LEDGE_COST, _BRINK_COST = 1.5, 12.0


class Beliefs:
    """Seen slots and pools of one episode; `costs` is the flat cost list of Grid for the present belief."""

    def __init__(self, terrain: Terrain, grid: Grid, layout: Layout, skill: Skill, rng: np.random.Generator) -> None:
        self._terrain, self._grid, self._layout, self._skill, self._rng = terrain, grid, layout, skill, rng
        self._slots: dict[tuple[int, int], bool] = {}
        self._pools: set[int] = set()
        self._missed: set[int] = set()
        self._taste_HW = _taste(grid, skill.variety, rng)
        wall_HW = grid.empty()
        wall_HW[grid.inside(wall.rect for wall in terrain.walls)] = np.inf
        self._walls: list[float] = wall_HW.ravel().tolist()
        self.costs = self._believed()

    def look(self, character: Character) -> bool:
        """Take in what has come into view; True when the belief changed."""
        if self._skill.grounded and not (character.on_ground and character.z < _LEVEL_M):
            return False
        changed = False
        for r, river in enumerate(self._terrain.rivers):
            for s, slot in enumerate(river.slots):
                if (r, s) not in self._slots and self._sees(character, slot):
                    wrong = self._rng.random() < self._skill.misjudge_chance
                    self._slots[r, s] = self._layout.bridges[r][s] != wrong
                    changed = True
        for i, pool in enumerate(self._layout.pools):
            if i not in self._pools and i not in self._missed and self._sees(character, pool.rect):
                missed = self._rng.random() < self._skill.misjudge_chance
                (self._missed if missed else self._pools).add(i)
                changed = changed or not missed
        if changed:
            self.costs = self._believed()
        return changed

    def doubtful(self, character: Character) -> bool:
        """Whether a crossing that has not been seen yet is near."""
        return any(
            (r, s) not in self._slots and _gap_m(slot, character.x, character.y) < _DOUBTFUL_M
            for r, river in enumerate(self._terrain.rivers)
            for s, slot in enumerate(river.slots)
        )

    def _sees(self, character: Character, rect: Rect) -> bool:
        if _gap_m(rect, character.x, character.y) > self._skill.sight_m:
            return False
        x, y = (rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2
        bearing = math.atan2(y - character.y, x - character.x)
        if abs(math.remainder(bearing - character.yaw, math.tau)) > _VIEW_RAD:
            return False
        return self._grid.clear(self._walls, (character.x, character.y), (x, y), math.inf)

    def _believed(self) -> list[float]:
        grid, terrain = self._grid, self._terrain
        costs_HW = grid.empty() * self._taste_HW
        costs_HW[grid.inside(ledge.rect for ledge in terrain.ledges)] *= _LEDGE_COST
        deadly = [hazard.rect for hazard in terrain.hazards]
        deadly += [self._layout.pools[i].rect for i in self._pools]
        for r, river in enumerate(terrain.rivers):
            seen = [self._slots.get((r, s)) for s in range(len(river.slots))]
            deadly += open_stretches(river, tuple(stands is not False for stands in seen))
            for slot, stands in zip(river.slots, seen, strict=True):
                if stands is None:
                    across_m = min(slot[2] - slot[0], slot[3] - slot[1])
                    costs_HW[grid.inside((slot,))] += _DOUBT_M / max(across_m, 1.0)
        costs_HW[grid.inside(deadly, self._skill.brink_m)] += _BRINK_COST
        costs_HW[grid.inside(deadly)] = np.inf
        costs_HW[grid.inside(wall.rect for wall in terrain.walls)] = np.inf
        costs: list[float] = costs_HW.ravel().tolist()
        return costs


def _gap_m(rect: Rect, x: float, y: float) -> float:
    """Distance from a point to the nearest edge of a rectangle, 0 inside."""
    return math.hypot(max(rect[0] - x, 0.0, x - rect[2]), max(rect[1] - y, 0.0, y - rect[3]))


def _taste(grid: Grid, variety: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """A smooth random factor of at least 1 on every cell, so that no two episodes take the same way."""
    coarse = rng.uniform(0.0, variety, size=(grid.height // 8 + 2, grid.width // 8 + 2))
    return 1.0 + np.kron(coarse, np.ones((8, 8)))[: grid.height, : grid.width]
