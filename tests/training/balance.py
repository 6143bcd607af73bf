"""Traces of gymnasium's CartPole: an environment that knows nothing of this project, with a discrete action."""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer

__all__ = ["CARTPOLE", "write_cartpole"]

CARTPOLE = "CartPole-v1"


def _episode(env: gymnasium.Env, seed: int, steps: int) -> EpisodeBuffer:
    """A player that balances: it pushes to where the pole is about to fall."""
    observation, _ = env.reset(seed=seed)
    observations, actions = [observation], []
    for _ in range(steps):
        actions.append(int(0.1 * observation[0] + 0.3 * observation[1] + observation[2] + 0.5 * observation[3] > 0.0))
        observation, *_ = env.step(actions[-1])
        observations.append(observation)
    last = np.arange(steps) == steps - 1
    return EpisodeBuffer(
        observations=np.array(observations),
        actions=np.array(actions),
        rewards=[1.0] * steps,
        terminations=[False] * steps,
        truncations=last.tolist(),
    )


def write_cartpole(root: Path, monkeypatch: pytest.MonkeyPatch, episodes: int = 12) -> Path:
    """A Minari dataset at root/cartpole/test-v0."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    env = gymnasium.make(CARTPOLE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # minari asks for authors
        minari.create_dataset_from_buffers(
            dataset_id="cartpole/test-v0",
            buffer=[_episode(env, seed, 60) for seed in range(episodes)],
            observation_space=env.observation_space,
            action_space=env.action_space,
            author="tests",
            author_email="tests",
            code_permalink="none",
            algorithm_name="scripted",
            description="balancing",
        )
    return root / "cartpole" / "test-v0"
