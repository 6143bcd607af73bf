"""The map in pybullet: bodies, one character, what kills it and what its rays hit.

This module knows nothing about goals, rewards or players. Moving hazards between episodes is cheap; bodies are built
once a world.
"""

from __future__ import annotations

import numpy as np
import pybullet
from numpy.typing import NDArray

from game import rays
from game.character import DECISION_S, TICKS, Character
from game.layout import Layout
from game.terrain import Rect, Terrain

__all__ = ["World"]

_CHARACTER, _SOLID, _SEEN = 2, 4, 8
"""Collision groups. A ray belongs to Bullet's default group 1; only bodies whose mask has 1 can be hit by it, which
keeps the character out of its own rays. Hazards and bridges are seen by rays and touched by nobody."""
_EDGE_WALL_M = 3.0
_HAZARD_TOP_M, _BRIDGE_TOP_M = 0.01, 0.02
_TOUCH_M = 0.08
"""Feet lower than this touch the ground, and so what lies on it."""
_PARKED_M = -20.0


class World:
    """One character in one map, in its own pybullet client (DIRECT: no window).

    `character` is public; `place` puts a layout in, `advance` plays one decision, `cast` asks for rays.
    """

    def __init__(self, terrain: Terrain) -> None:
        self._client = pybullet.connect(pybullet.DIRECT)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=DECISION_S / TICKS, numSolverIterations=10, deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )  # fmt: skip
        self._terrain = terrain
        self._class_of: dict[int, int] = {-1: 0}
        self._deadly: tuple[Rect, ...] = ()
        self._build_fixed()
        self._bridges = [
            [self._seen("ground", slot, _BRIDGE_TOP_M) for slot in river.slots] for river in terrain.rivers
        ]
        self._pools = self._build_pools()
        self.character = Character(self._client, _CHARACTER, _SOLID)
        self._class_by_body = np.array([self._class_of.get(body, 0) for body in range(self.character.body + 1)] + [0])

    def close(self) -> None:
        """Free the pybullet client; closing twice is fine."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1

    def place(self, layout: Layout) -> None:
        """Raise the standing bridges, lay the pools, put the character at the start."""
        self._deadly = layout.deadly
        for river, bodies, standing in zip(self._terrain.rivers, self._bridges, layout.bridges, strict=True):
            for slot, body, stands in zip(river.slots, bodies, standing, strict=True):
                self._move(body, slot if stands else None)
        spare = {key: list(bodies) for key, bodies in self._pools.items()}
        for pool in layout.pools:
            body = spare[pool.kind, round(pool.rect[2] - pool.rect[0])].pop()
            self._move(body, pool.rect)
        for bodies in spare.values():
            for body in bodies:
                self._move(body, None)
        self.character.place(*layout.start, layout.start_yaw)
        pybullet.performCollisionDetection(physicsClientId=self._client)

    def advance(self, turn: float, forward: float, jump: bool) -> bool:
        """Play one decision (TICKS ticks); True when the character touched lava or water, which stops the clock."""
        character = self.character
        character.decide(turn, forward, jump)
        for _ in range(TICKS):
            character.before_tick()
            pybullet.stepSimulation(physicsClientId=self._client)
            character.after_tick()
            if character.z < _TOUCH_M and self.deadly(character.x, character.y):
                character.feel_ground()
                return True
        character.feel_ground()
        return False

    def deadly(self, x: float, y: float) -> bool:
        """Whether lava or water without a bridge lies at a point."""
        return any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in self._deadly)

    def cast(self, query_M: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Cast the rays marked in the query, and only those; dense values [D], zero where nothing was asked."""
        chosen = np.flatnonzero(query_M)
        if len(chosen) == 0:
            return rays.encode(chosen, [], chosen)
        character = self.character
        starts, ends = rays.segments(chosen, character.x, character.y, character.z, character.yaw)
        hits = pybullet.rayTestBatch(
            starts, ends, numThreads=1, collisionFilterMask=_SOLID | _SEEN, physicsClientId=self._client
        )
        bodies = [hit[0] for hit in hits]
        return rays.encode(chosen, [hit[2] for hit in hits], self._class_by_body[bodies])

    def _build_fixed(self) -> None:
        half_x, half_y = (extent / 2 for extent in self._terrain.size_m)
        self._solid("ground", (-half_x - 2, -half_y - 2, half_x + 2, half_y + 2), -1.0, 0.0)
        for edge in (
            (-half_x - 1, -half_y - 1, -half_x, half_y + 1), (half_x, -half_y - 1, half_x + 1, half_y + 1),
            (-half_x, -half_y - 1, half_x, -half_y), (-half_x, half_y, half_x, half_y + 1),
        ):  # fmt: skip
            self._solid("wall", edge, 0.0, _EDGE_WALL_M)
        for wall in self._terrain.walls:
            self._solid("wall", wall.rect, 0.0, wall.height_m)
        for ledge in self._terrain.ledges:
            self._solid("ground", ledge.rect, 0.0, ledge.height_m)
        for hazard in (*self._terrain.hazards, *self._terrain.rivers):
            self._seen(hazard.kind, hazard.rect, _HAZARD_TOP_M)

    def _build_pools(self) -> dict[tuple[str, int], list[int]]:
        """Enough bodies of each kind and size for any draw."""
        pools: dict[tuple[str, int], list[int]] = {}
        for zone in self._terrain.pools:
            square = (0.0, 0.0, float(zone.size_m), float(zone.size_m))
            for kind in ("lava", "water"):
                bodies = pools.setdefault((kind, zone.size_m), [])
                bodies += [self._seen(kind, square, _HAZARD_TOP_M) for _ in range(zone.count)]
        return pools

    def _solid(self, kind: str, rect: Rect, bottom_m: float, top_m: float) -> int:
        return self._box(kind, rect, bottom_m, top_m, _SOLID, 1 | _CHARACTER)

    def _seen(self, kind: str, rect: Rect, top_m: float) -> int:
        return self._box(kind, rect, -top_m, top_m, _SEEN, 1)

    def _box(self, kind: str, rect: Rect, bottom_m: float, top_m: float, group: int, mask: int) -> int:
        half = ((rect[2] - rect[0]) / 2, (rect[3] - rect[1]) / 2, (top_m - bottom_m) / 2)
        centre = ((rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2, (top_m + bottom_m) / 2)
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
        body: int = pybullet.createMultiBody(0.0, shape, basePosition=centre, physicsClientId=self._client)
        pybullet.changeDynamics(body, -1, lateralFriction=0, restitution=0, physicsClientId=self._client)
        pybullet.setCollisionFilterGroupMask(body, -1, group, mask, physicsClientId=self._client)
        self._class_of[body] = rays.CLASSES.index(kind)
        return body

    def _move(self, body: int, rect: Rect | None) -> None:
        """Centre a thin body on a rectangle, or park it under the ground."""
        centre = (0.0, 0.0, _PARKED_M) if rect is None else ((rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2, 0.0)
        pybullet.resetBasePositionAndOrientation(body, centre, (0, 0, 0, 1), physicsClientId=self._client)
