from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.training import toy
from training.shards import write_shards
from training.traces import load_traces
from training.train import train
from training.update import TrainState


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """Two test processes share two cores; sums must not depend on how many threads made them."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as monkeypatch:
        return toy.write_dataset(tmp_path_factory.mktemp("datasets"), monkeypatch)


@pytest.fixture(scope="session")
def trained(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainState]:
    """One finished run on the toy traces, shared by the tests that only look at it."""
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("run")
    return out, train(toy.config(dataset, out, updates=250, learning_rate=5e-3, budget=0.2, penalty_step=0.01))


@pytest.fixture(scope="session")
def shards(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy traces as several shards of several row groups."""
    out, traces = tmp_path_factory.mktemp("streams") / "toy", load_traces(dataset)
    write_shards(traces.layout, map(traces.episode, range(len(traces))), out, shard_mb=0.01, group_mb=0.004)
    return out
