"""The toy problem as an environment: one point for every push the right way (tests/training/toy.py)."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from tests.training.toy import ACTION, FEATURES

__all__ = ["TOY", "ToyGame"]

TOY = "tests.training.toy_game:Toy-v0"
LENGTH = 8

Observation = dict[str, NDArray[np.float32]]


class ToyGame(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Eight pushes."""

    def __init__(self) -> None:
        box = gymnasium.spaces.Box
        self.observation_space = gymnasium.spaces.Dict(
            {"free": box(-1.0, 100.0, (FEATURES.n_free,)), "costly": box(-1.0, 1.0, (FEATURES.n_costly,))}
        )
        self.action_space = box(-1.0, 1.0, (ACTION.size,))
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        super().reset(seed=seed)
        self._steps = 0
        return self._observe(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        right = self._costly[0 if self._free[0] == 0.0 else 2]
        reward = float(np.sign(action[0]) == np.sign(right))
        self._steps += 1
        return self._observe(), reward, False, self._steps == LENGTH, {}

    def _observe(self) -> Observation:
        self._free = np.array([self.np_random.integers(0, 2), self._steps], dtype=np.float32)
        self._costly = self.np_random.uniform(-1.0, 1.0, FEATURES.n_costly).astype(np.float32)
        return {"free": self._free, "costly": self._costly}


gymnasium.register(id="Toy-v0", entry_point="tests.training.toy_game:ToyGame")
