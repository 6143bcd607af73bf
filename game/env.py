"""The navigation game as a gymnasium environment, and the feature table and action layout that describe it.

This module knows nothing about servers, models or players.

`gymnasium.make("game.env:Navigation-v0", map="hard")` casts every ray each step. A client that pays for rays uses
`env.unwrapped`: `observe_free()`, `cast(query_M)`, `advance(action)`; `step` is those three composed.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from game.layout import Layout, draw_layout
from game.rays import RayCosts, load_costs, ray_features
from game.terrain import load_map
from game.world import World
from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable

__all__ = ["ACTION_SPEC", "MAX_DECISIONS", "REACH_M", "NavigationEnv", "feature_table"]

MAX_DECISIONS = 400
"""40 s: about twice what a good player needs on hard."""
REACH_M = 1.5
ACTION_SPEC = ActionSpec(
    (
        ActionComponent("turn", -1.0, 1.0, 0.0),
        ActionComponent("forward", 0.0, 1.0, 0.0),
        ActionComponent("jump", 0.0, 1.0, 0.0),
    )
)
"""turn: 1 is 30 degrees to the left; forward: 1 is 5 m/s; jump: above 0.5 presses, ignored in the air."""

_FREE = (
    Feature("position", 3, low=-64.0, high=64.0),
    Feature("orientation", 2, low=-1.01, high=1.01),
    Feature("velocity", 3, low=-32.0, high=32.0),
    Feature("goal", 3, low=-64.0, high=64.0),
    Feature("goal_relative", 3, low=-160.0, high=160.0),
    Feature("on_ground", 1, low=0.0, high=1.0),
)
Observation = dict[str, NDArray[np.float32]]


def feature_table(costs: RayCosts | None = None) -> FeatureTable:
    """What a character can know: six free features (F = 15), then one costly feature a ray; default: Godot's costs."""
    return FeatureTable(_FREE + ray_features(load_costs() if costs is None else costs))


class NavigationEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Walk to the goal of a map without touching lava or water.

    Observation: `free` [F], `costly` [D]. Action: `ACTION_SPEC`. Reward: gain in the smallest distance to the goal so
    far, scaled so that an episode that arrives sums to 100. Death and arrival terminate, time truncates; `info` has
    `died`, `reached` and `distance_m`. The same seed gives the same layout, and with the same actions the same episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  (gymnasium's own spelling)

    def __init__(self, map: str = "hard", costs: str = "godot", max_decisions: int = MAX_DECISIONS) -> None:
        self.terrain = load_map(map)
        self.table = feature_table(load_costs(costs))
        self.max_decisions = max_decisions
        self.world = World(self.terrain)
        self.layout: Layout | None = None
        free_low, free_high = self.table.free_range
        costly_low, costly_high = self.table.costly_range
        self.observation_space = gymnasium.spaces.Dict(
            {
                "free": gymnasium.spaces.Box(free_low, free_high, dtype=np.float32),
                "costly": gymnasium.spaces.Box(costly_low, costly_high, dtype=np.float32),
            }
        )
        low, high = zip(*((part.low, part.high) for part in ACTION_SPEC.components), strict=True)
        self.action_space = gymnasium.spaces.Box(np.float32(low), np.float32(high), dtype=np.float32)
        self._everything_M = np.ones(self.table.n_queries, dtype=bool)
        self._initial_m = self._best_m = 1.0
        self._decisions = 0
        self._died = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw an episode from the seed (or from the generator that the last seed left) and cast every ray."""
        info = self.restart(seed=seed)
        return self._observe(), info

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One decision of 0.1 s, then every ray."""
        reward, terminated, truncated, info = self.advance(action)
        return self._observe(), reward, terminated, truncated, info

    def close(self) -> None:
        """Free the physics."""
        self.world.close()

    def restart(self, *, seed: int | None = None) -> dict[str, Any]:
        """`reset` without casting a ray; returns info."""
        super().reset(seed=seed)
        self.layout = draw_layout(self.terrain, self.np_random)
        self.world.place(self.layout)
        self._initial_m = self._best_m = self._distance_m()
        self._decisions, self._died = 0, False
        return self._info()

    def advance(self, action: NDArray[np.float32]) -> tuple[float, bool, bool, dict[str, Any]]:
        """`step` without casting a ray: reward, terminated, truncated, info. Out-of-range actions are clipped."""
        turn, forward, jump = (float(number) for number in action)
        turn, forward = min(max(turn, -1.0), 1.0), min(max(forward, 0.0), 1.0)
        self._died = self.world.advance(turn, forward, jump > 0.5)
        self._decisions += 1
        distance_m = max(self._distance_m(), REACH_M)
        gain_m = 0.0 if self._died else max(self._best_m - distance_m, 0.0)
        self._best_m -= gain_m
        info = self._info()
        terminated = self._died or bool(info["reached"])
        truncated = not terminated and self._decisions >= self.max_decisions
        return 100.0 * gain_m / (self._initial_m - REACH_M), terminated, truncated, info

    def observe_free(self) -> NDArray[np.float32]:
        """The free numbers of this moment, shape [F], in the order of the feature table."""
        who, layout = self.world.character, self._playing()
        cos, sin = math.cos(who.yaw), math.sin(who.yaw)
        ahead, aside = layout.goal[0] - who.x, layout.goal[1] - who.y
        return np.array(
            [
                who.x, who.y, who.z, cos, sin, *who.velocity, *layout.goal, 0.0,
                cos * ahead + sin * aside, cos * aside - sin * ahead, -who.z, float(who.on_ground),
            ],
            dtype=np.float32,
        )  # fmt: skip

    def cast(self, query_M: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Values [D] of the rays asked for, zero elsewhere; nothing else is cast."""
        return self.world.cast(query_M)

    def _observe(self) -> Observation:
        return {"free": self.observe_free(), "costly": self.cast(self._everything_M)}

    def _playing(self) -> Layout:
        if self.layout is None:
            raise gymnasium.error.ResetNeeded("reset the environment before playing")
        return self.layout

    def _distance_m(self) -> float:
        goal = self._playing().goal
        return math.hypot(goal[0] - self.world.character.x, goal[1] - self.world.character.y)

    def _info(self) -> dict[str, Any]:
        distance_m = self._distance_m()
        return {"died": self._died, "reached": not self._died and distance_m <= REACH_M, "distance_m": distance_m}


gymnasium.register(id="Navigation-v0", entry_point="game.env:NavigationEnv", order_enforce=False)
for _shipped in ("easy", "hard"):
    gymnasium.register(
        id=f"Navigation-{_shipped}-v0",
        entry_point="game.env:NavigationEnv",
        kwargs={"map": _shipped},
        order_enforce=False,
    )
