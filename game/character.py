"""A walking, turning, jumping capsule.

This module knows nothing about maps, rays or rewards.
"""

from __future__ import annotations

import math

import pybullet

__all__ = ["DECISION_S", "EYE_M", "HEIGHT_M", "JUMP_M_S", "RADIUS_M", "SPEED_M_S", "TICKS", "TURN_RAD", "Character"]

TICKS = 6
"""Physics ticks in one decision: 60 Hz under 10 decisions a second."""
DECISION_S = 0.1
SPEED_M_S = 5.0
TURN_RAD = math.radians(30.0)
JUMP_M_S = 3.9
"""Upward speed of a jump: 0.78 m high, 0.8 s long, 4 m across at full speed."""
RADIUS_M = 0.3
HEIGHT_M = 1.4
EYE_M = 1.2
_STANDS = 0.5
"""A contact whose normal points up at least this much carries the character."""


class Character:
    """A dynamic pybullet capsule whose rotation is locked; its heading `yaw` is kept here.

    Read after each tick: `x`, `y`, `z` of the feet in metres, `velocity` in m/s, `yaw` in radians, `on_ground`.
    """

    def __init__(self, client: int, group: int, touches: int) -> None:
        self._client = client
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CAPSULE, radius=RADIUS_M, height=HEIGHT_M - 2 * RADIUS_M, physicsClientId=client
        )
        self.body = pybullet.createMultiBody(1.0, shape, physicsClientId=client)
        pybullet.changeDynamics(
            self.body, -1, localInertiaDiagonal=(0, 0, 0), lateralFriction=0, restitution=0, linearDamping=0,
            angularDamping=0, activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client,
        )  # fmt: skip
        pybullet.setCollisionFilterGroupMask(self.body, -1, group, touches, physicsClientId=client)
        self.x = self.y = self.z = self.yaw = 0.0
        self.velocity = (0.0, 0.0, 0.0)
        self.on_ground = True
        self._walk = (0.0, 0.0)

    def place(self, x: float, y: float, yaw: float) -> None:
        """Stand still on the ground at a point, looking along yaw."""
        centre = (x, y, HEIGHT_M / 2)
        pybullet.resetBasePositionAndOrientation(self.body, centre, (0, 0, 0, 1), physicsClientId=self._client)
        pybullet.resetBaseVelocity(self.body, (0, 0, 0), (0, 0, 0), physicsClientId=self._client)
        self.x, self.y, self.z, self.yaw = x, y, 0.0, yaw
        self.velocity, self.on_ground, self._walk = (0.0, 0.0, 0.0), True, (0.0, 0.0)

    def decide(self, turn: float, forward: float, jump: bool) -> None:
        """Turn at once, then walk along the new heading until the next decision; a jump in the air is ignored."""
        self.yaw = math.remainder(self.yaw + turn * TURN_RAD, math.tau)
        speed = forward * SPEED_M_S
        self._walk = (speed * math.cos(self.yaw), speed * math.sin(self.yaw))
        if jump and self.on_ground:
            self.velocity = (self.velocity[0], self.velocity[1], JUMP_M_S)

    def before_tick(self) -> None:
        """Walk: horizontal speed is set, vertical speed is left to gravity."""
        velocity = (*self._walk, self.velocity[2])
        pybullet.resetBaseVelocity(self.body, velocity, physicsClientId=self._client)

    def after_tick(self) -> None:
        """Read where physics has brought the capsule."""
        (self.x, self.y, z), _ = pybullet.getBasePositionAndOrientation(self.body, physicsClientId=self._client)
        self.z = z - HEIGHT_M / 2
        self.velocity, _ = pybullet.getBaseVelocity(self.body, physicsClientId=self._client)

    def feel_ground(self) -> None:
        """Set `on_ground` from the contacts of the last tick."""
        contacts = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self._client)
        self.on_ground = self.velocity[2] < 1.0 and any(contact[7][2] > _STANDS for contact in contacts)
