"""A toy decision problem whose answer is known: only the costly feature named by a free number tells the action.

Free: `which` (0 or 1). Costly: `left` (2 numbers), `right` (1), `noise` (3), `dear` (1). The right action is the sign
of left[0] when which is 0 and of right[0] when it is 1: half the frames need `left`, half `right`, none the others.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import gymnasium as gym
import minari
import msgspec
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer

from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable
from training.config import TrainConfig
from training.traces import Batch, Traces, choose_windows, read_windows

FEATURES = FeatureTable(
    (
        Feature("which", 1, low=-1.0, high=2.0),
        Feature("clock", 1, low=0.0, high=100.0),
        Feature("left", 2, 1.0, low=-5.0, high=5.0),
        Feature("right", 1, 1.0, low=-5.0, high=5.0),
        Feature("noise", 3, 2.0, low=-9.0, high=9.0),
        Feature("dear", 1, 4.0, low=-9.0, high=9.0),
    )
)
ACTION = ActionSpec((ActionComponent("push", -1.0, 1.0), ActionComponent("wait", 0.0, 1.0)))


def episode(rng: np.random.Generator, length: int) -> EpisodeBuffer:
    which = rng.integers(0, 2, length + 1)
    free = np.stack([which, np.arange(length + 1)], 1).astype(np.float32)
    costly = rng.uniform(-1, 1, (length + 1, FEATURES.n_costly)).astype(np.float32)
    push = np.sign(np.where(which == 0, costly[:, 0], costly[:, 2]))[:length]
    rewards = rng.uniform(0, 1, length)
    ends = np.zeros(length, bool)
    ends[-1] = True
    return EpisodeBuffer(
        observations={"free": free, "costly": costly},
        actions=np.stack([push, np.zeros(length)], 1).astype(np.float32),
        rewards=list(rewards),
        terminations=list(ends),
        truncations=list(np.zeros(length, bool)),
    )


def write_dataset(root: Path, monkeypatch: pytest.MonkeyPatch, episodes: int = 40, seed: int = 0) -> Path:
    """A Minari dataset at root/toy/test-v0."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    rng = np.random.default_rng(seed)
    box = gym.spaces.Box
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # minari asks for an environment; traces need none
        dataset = minari.create_dataset_from_buffers(
            dataset_id="toy/test-v0",
            buffer=[episode(rng, int(rng.integers(8, 30))) for _ in range(episodes)],
            observation_space=gym.spaces.Dict(
                {
                    "free": box(-np.inf, np.inf, (FEATURES.n_free,), np.float32),
                    "costly": box(-np.inf, np.inf, (FEATURES.n_costly,), np.float32),
                }
            ),
            action_space=box(-1, 1, (ACTION.size,), np.float32),
            author="tests",
            author_email="tests",
            code_permalink="none",
            algorithm_name="toy",
            description="toy",
        )
    dataset.storage.update_metadata(
        {"features": msgspec.json.encode(FEATURES).decode(), "action": msgspec.json.encode(ACTION).decode()}
    )
    return root / "toy" / "test-v0"


def windows(traces: Traces, batch: int, length: int, generator: np.random.Generator, beginnings: float = 0.0) -> Batch:
    """Windows of traces, drawn and read."""
    return read_windows(traces, choose_windows(traces, batch, length, generator, beginnings))


def config(dataset: Path, out: Path, **settings: object) -> TrainConfig:
    """A small run on the toy traces."""
    defaults: dict[str, object] = {
        "name": "toy",
        "bins": (3, 2),
        "context_length": 5,
        "window": 12,
        "width": 16,
        "n_heads": 2,
        "encoder_width": 32,
        "fourier": 1,
        "batch": 16,
        "updates": 60,
        "log_every": 10,
        "checkpoint_every": 20,
    }
    return TrainConfig(dataset=dataset, out=out, **(defaults | settings))
