"""One environment as evaluation plays it: only what was asked for is looked at and, where possible, paid for.

Any gymnasium environment will do whose observation is {"free": [F], "costly": [D]}, or that a feature map makes so. One
that also offers the four calls of `Paying` acquires nothing but what is asked of it, which saves most of its time at a
small budget. This module knows nothing about bundles, bots or budgets.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import gymnasium
import numpy as np
from numpy.typing import NDArray

from protocol.features import FeatureTable
from training.feature_map import FeatureMap, Parts, parts_of

__all__ = ["Environment", "Outcome", "Paying", "open_environment"]

_Floats = NDArray[np.float32]
_Bools = NDArray[np.bool_]


class Outcome(NamedTuple):
    """What one action led to."""

    reward: float
    terminated: bool
    truncated: bool


class Environment(Protocol):
    """What evaluation needs of an environment."""

    def restart(self, seed: int) -> None:
        """Begin the episode of this seed."""

    def free(self) -> _Floats:
        """The free numbers of this moment, shape [F]."""

    def acquire(self, query_M: _Bools) -> _Floats:
        """The costly numbers asked for, shape [D], zero elsewhere."""

    def advance(self, action_A: _Floats) -> Outcome:
        """Play one action."""


@runtime_checkable
class Paying(Protocol):
    """An environment whose features can be acquired one by one: `step` is `advance`, `observe_free` and `cast`."""

    def restart(self, *, seed: int | None = None) -> dict[str, Any]:
        """`reset` without acquiring anything."""

    def observe_free(self) -> _Floats:
        """The free numbers, shape [F]."""

    def cast(self, query_M: _Bools) -> _Floats:
        """The costly numbers asked for, shape [D], zero elsewhere."""

    def advance(self, action: _Floats) -> tuple[float, bool, bool, dict[str, Any]]:
        """`step` without acquiring anything."""


def open_environment(name: str, features: FeatureTable, feature_map: FeatureMap | None = None) -> Environment:
    """Make the environment with this gymnasium id, which must show these features, by this map if it has one.

    Raises ValueError for an id that is not known, whose module or simulator is not installed, or which shows others.
    """
    try:
        env = gymnasium.make(name)
    except (gymnasium.error.Error, ImportError) as error:
        raise ValueError(f"environment {name}: {error}") from error
    _check_features(name, env.observation_space, features, feature_map)
    if feature_map is not None:
        return _Mapped(env, features.owner, feature_map)
    bare = env.unwrapped
    # A time limit is a wrapper's: going around it would play longer episodes.
    if isinstance(bare, Paying) and env.spec is not None and env.spec.max_episode_steps is None:
        return _Paid(bare)
    return _Whole(env, features.owner)


def _check_features(
    name: str, space: gymnasium.Space[Any], features: FeatureTable, feature_map: FeatureMap | None
) -> None:
    sizes = {key: part.shape[1] for key, part in _parts(space.sample()).items()}
    if feature_map is None:
        expected = {"free": features.n_free, "costly": features.n_costly}
        if {key: sizes.get(key, 0) for key in expected} != expected:
            raise ValueError(f"environment {name} shows {sizes} numbers, the bundle reads {expected}")
        return
    try:
        shown = feature_map.table(sizes)
    except ValueError as error:
        raise ValueError(f"environment {name}: {error}") from error
    if shown != features:
        raise ValueError(f"environment {name} shows other features by the bundle's map than the bundle reads")


def _parts(observation: Any) -> Parts:
    """One observation as a feature map finds its parts."""
    alone = {key: [part] for key, part in observation.items()} if isinstance(observation, dict) else [observation]
    return parts_of(alone, 1)


class _Paid:
    """Acquires what is asked for and nothing else."""

    def __init__(self, env: Paying) -> None:
        self._env = env
        self.free = env.observe_free
        self.acquire = env.cast

    def restart(self, seed: int) -> None:
        self._env.restart(seed=seed)

    def advance(self, action_A: _Floats) -> Outcome:
        reward, terminated, truncated, _ = self._env.advance(action_A)
        return Outcome(float(reward), bool(terminated), bool(truncated))


class _Whole:
    """Observes everything each step, and hands on what is asked for."""

    def __init__(self, env: gymnasium.Env[Any, Any], owner_D: NDArray[np.int64]) -> None:
        self._env, self._owner_D = env, owner_D
        self._observation: dict[str, _Floats] = {}

    def restart(self, seed: int) -> None:
        self._observation = self._split(self._env.reset(seed=seed)[0])

    def free(self) -> _Floats:
        return self._observation["free"]

    def acquire(self, query_M: _Bools) -> _Floats:
        return np.where(query_M[self._owner_D], self._observation["costly"], np.float32(0.0))

    def advance(self, action_A: _Floats) -> Outcome:
        observation, reward, terminated, truncated, _ = self._env.step(self._action(action_A))
        self._observation = self._split(observation)
        return Outcome(float(reward), bool(terminated), bool(truncated))

    def _split(self, observation: Any) -> dict[str, _Floats]:
        return observation

    def _action(self, action_A: _Floats) -> Any:
        return action_A


class _Mapped(_Whole):
    """An environment with an observation of its own, in which a feature map finds the features."""

    def __init__(self, env: gymnasium.Env[Any, Any], owner_D: NDArray[np.int64], feature_map: FeatureMap) -> None:
        super().__init__(env, owner_D)
        self._map, self._chance = feature_map, np.random.default_rng()
        self._is_choice = isinstance(env.action_space, gymnasium.spaces.Discrete)
        self._whole = env.action_space.dtype if np.issubdtype(env.action_space.dtype, np.integer) else None

    def restart(self, seed: int) -> None:
        self._chance = np.random.default_rng([seed, 1])  # of the noise: [seed] alone is the environment's own chance
        super().restart(seed)

    def _split(self, observation: Any) -> dict[str, _Floats]:
        free_1F, costly_1D = self._map.split(_parts(observation), self._chance)
        return {"free": free_1F[0], "costly": costly_1D[0]}

    def _action(self, action_A: _Floats) -> Any:
        if self._is_choice:
            return round(float(action_A[0]))
        return action_A if self._whole is None else np.rint(action_A).astype(self._whole)
