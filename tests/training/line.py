"""A tiny environment for evaluation: episodes of known lengths over the features of `tests.bundles`, and a diary."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tests.bundles import FEATURES

__all__ = ["LINE", "TIMED_LINE", "Line", "length_of"]

LINE = "tests.training.line:Line-v0"
TIMED_LINE = "tests.training.line:Timed-line-v0"
TIME_LIMIT = 2

Observation = dict[str, NDArray[np.float32]]


def length_of(seed: int) -> int:
    """How many steps the episode of this seed has."""
    return 3 + seed * 7 % 5


class Line(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Pays one point a step. `diary` notes the seed of every step of every episode in this process."""

    diary: list[int] = []  # noqa: RUF012  (one for all on purpose)

    def __init__(self) -> None:
        low, high = FEATURES.free_range
        self.observation_space = gymnasium.spaces.Dict(
            {
                "free": gymnasium.spaces.Box(low, high, dtype=np.float32),
                "costly": gymnasium.spaces.Box(*FEATURES.costly_range, dtype=np.float32),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self._steps = self._seed = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._seed, self._steps = seed or 0, 0
        return self._observe(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        self._steps += 1
        self.diary.append(self._seed)
        return self._observe(), 1.0, self._steps == length_of(self._seed), False, {}

    def _observe(self) -> Observation:
        random = np.random.default_rng((self._seed, self._steps))
        free = random.uniform(-1.0, 1.0, FEATURES.n_free).astype(np.float32)
        return {"free": free, "costly": random.uniform(0.0, 1.0, FEATURES.n_costly).astype(np.float32)}


gymnasium.register(id="Line-v0", entry_point="tests.training.line:Line")
gymnasium.register(id="Timed-line-v0", entry_point="tests.training.line:Line", max_episode_steps=TIME_LIMIT)
