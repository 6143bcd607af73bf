"""Scripted players, and the kicks that disturb them while they are recorded.

A player knows the map by heart but not the episode: which bridges stand and where pools lie it must see, within its
sight and field of view, as an agent with rays must. It walks down a cost-to-go field over what it believes.

This module knows nothing about rays, rewards or files.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from game.beliefs import Beliefs
from game.character import SPEED_M_S, TURN_RAD, Character
from game.env import NavigationEnv
from game.grid import Grid
from game.layout import Layout
from game.skills import Skill
from game.terrain import Terrain

__all__ = ["Kicks", "Player"]

_AIM_CELLS = 7
_LEDGE_AHEAD_M = (0.35, 0.7, 1.1, 1.5)
_ON_TOP_M = 0.05
_KICK_TURNS = 4.0  # most that a whole kick turns, in units of 30 degrees
_KICK_MARGIN_M = 0.3  # between what the next decision may reach and a brink
_MARGIN_COST = 4.0
"""Cells cheaper than this may be walked straight through; dearer ones lie on the brink of a hazard."""


class Player:
    """Plays one episode after another: `start` looks at the map anew, `act` answers the intended action."""

    def __init__(self, skill: Skill, terrain: Terrain) -> None:
        self.skill = skill
        self._terrain = terrain
        self._grid = Grid(terrain)
        self._ledges = [(ledge.rect, ledge.height_m) for ledge in terrain.ledges]

    def start(self, layout: Layout, rng: np.random.Generator) -> None:
        """Forget the last episode. `layout` is the truth, of which only what comes into view is used."""
        self._rng = rng
        self._goal = layout.goal
        self._beliefs = Beliefs(self._terrain, self._grid, layout, self.skill, rng)
        self._aims: list[tuple[float, float]] = []
        self._pause = 0
        self._efforts: list[float] = []

    def act(self, character: Character) -> NDArray[np.float32]:
        """Intended action [3] of this decision: turn, forward, jump."""
        if self._beliefs.look(character) or not self._efforts or not self._known(character):
            self._plan(character)
        self._aims.append(self._aim(character))
        aim = self._aims[max(-1 - self.skill.reaction, -len(self._aims))]
        error = math.remainder(math.atan2(aim[1] - character.y, aim[0] - character.x) - character.yaw, math.tau)
        turn = error / TURN_RAD + self._rng.normal(0.0, self.skill.turn_noise)
        forward = self._forward(character, error)
        jump = forward > 0.0 and self._ledge_ahead(character)
        return np.array([min(max(turn, -1.0), 1.0), forward, float(jump)], dtype=np.float32)

    def _plan(self, character: Character) -> None:
        grid = self._grid
        here = grid.cell(character.x, character.y)
        self._efforts = grid.cost_to_go(self._beliefs.costs, grid.cell(*self._goal), here)

    def _known(self, character: Character) -> bool:
        return math.isfinite(self._efforts[self._grid.cell(character.x, character.y)])

    def _aim(self, character: Character) -> tuple[float, float]:
        """The farthest point down the field that can be walked to in a straight line."""
        grid, costs = self._grid, self._beliefs.costs
        here = (character.x, character.y)
        if math.dist(here, self._goal) < _AIM_CELLS and grid.clear(costs, here, self._goal, _MARGIN_COST):
            return self._goal
        cell = grid.descend(costs, self._efforts, grid.cell(*here))
        aim = grid.centre(cell)
        for _ in range(_AIM_CELLS):
            cell = grid.descend(costs, self._efforts, cell)
            point = grid.centre(cell)
            if not grid.clear(costs, here, point, _MARGIN_COST):
                break
            aim = point
        return aim

    def _forward(self, character: Character, error: float) -> float:
        if self._pause > 0:
            self._pause -= 1
            return 0.0
        if character.on_ground and self._rng.random() < self.skill.pause_chance:
            self._pause = int(self._rng.integers(1, self.skill.pause_decisions, endpoint=True))
        if abs(error) > math.radians(75.0):
            return 0.2
        if abs(error) > math.radians(40.0) or self._beliefs.doubtful(character) or self._on_blind_ledge(character):
            return self.skill.careful_speed
        return self.skill.speed

    def _on_blind_ledge(self, character: Character) -> bool:
        """Whether what lies behind a ledge is yet to be seen: before it, above it and in the air after it."""
        return self.skill.grounded and (character.z > _ON_TOP_M or self._ledge_ahead(character))

    def _ledge_ahead(self, character: Character) -> bool:
        """Whether the way ahead soon meets a ledge that is higher than the feet: jump is held until over it."""
        cos, sin = math.cos(character.yaw), math.sin(character.yaw)
        for (x0, y0, x1, y1), height_m in self._ledges:
            if character.z > height_m - _ON_TOP_M:
                continue
            for reach_m in _LEDGE_AHEAD_M:
                x, y = character.x + reach_m * cos, character.y + reach_m * sin
                if x0 <= x <= x1 and y0 <= y <= y1:
                    return True
        return False


class Kicks:
    """Disturbs what is executed for some decisions now and then; what was intended is what gets recorded.

    Often and for long, so that where a character heads, and has headed, says less of what its player knows: an imitator
    that reads the player's mind off its path walks into whatever it did not look at. A kick may lead close to a brink,
    for how to leave one must be seen too; where the next decision could lead over it, the character only turns.
    """

    def __init__(self, rng: np.random.Generator, chance: float = 0.07, longest: int = 12) -> None:
        self._rng, self._chance, self._longest = rng, chance, longest
        self._left = 0
        self._push = np.zeros(3, dtype=np.float32)

    def executed(self, intended: NDArray[np.float32], env: NavigationEnv) -> NDArray[np.float32]:
        """The action to execute [3]."""
        if self._left == 0 and self._rng.random() < self._chance:
            self._left = int(self._rng.integers(1, self._longest, endpoint=True))
            turn = min(max(self._rng.uniform(-_KICK_TURNS, _KICK_TURNS) / self._left, -1.0), 1.0)
            self._push = np.array([turn, self._rng.uniform(0.3, 1), intended[2]], dtype=np.float32)
        if self._left == 0:
            return intended
        self._left -= 1
        return self._push if self._harmless(env) else self._push * np.float32([1, 0, 0])

    def _harmless(self, env: NavigationEnv) -> bool:
        who = env.world.character
        reach_m = SPEED_M_S * 0.1 + _KICK_MARGIN_M
        heading = who.yaw + float(self._push[0]) * TURN_RAD
        x, y = who.x + reach_m * math.cos(heading), who.y + reach_m * math.sin(heading)
        return who.on_ground and not env.world.deadly(x, y)
