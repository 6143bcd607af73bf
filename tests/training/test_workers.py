"""One run over two workers, started by torchrun: the network of one process, whatever is trained."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.training import toy
from tests.training.test_train import train_interrupted
from training import workers
from training.config import TrainConfig
from training.train import train

pytestmark = pytest.mark.timeout(600)  # three processes start, on cores that others may be using

CONDITIONED = {"budgets": (0.05, 0.3, 1.0), "control": "dual", "penalty_step": 0.05}
RUNS: dict[str, dict[str, object]] = {
    "frame": {**CONDITIONED, "allocation": "frame", "frame_bots": 4},
    "iql": {**CONDITIONED, "method": "iql"},
    "random": {"method": "rcbc", "acquisition": "random"},  # the acquisition head has no gradient
    "streamed": {"pool_mb": 0.02, "budget": 0.3},
}
TOLERANCE = 1e-5  # sums come in another order


def config(run: str, out: Path, dataset: Path, shards: Path) -> TrainConfig:
    source = shards if run == "streamed" else dataset
    return toy.config(source, out / run, updates=20, checkpoint_every=10, **RUNS[run])


@pytest.fixture(scope="module")
def shared(dataset: Path, shards: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of every run by two workers; that on streamed traces goes on where one process was stopped."""
    folder = tmp_path_factory.mktemp("workers")
    for run in RUNS:
        config(run, folder, dataset, shards).write(folder / f"{run}.json")
    train_interrupted(config("streamed", folder, dataset, shards), after=13)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += ["-m", "tests.training.two_workers", str(folder)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    return folder


@pytest.mark.parametrize("run", RUNS)
def test_two_workers_train_and_tell_what_one_does(
    run: str, shared: Path, dataset: Path, shards: Path, tmp_path: Path
) -> None:
    """Weights within rounding, γ exactly, and metrics of the whole batch, once."""
    state = train(config(run, tmp_path, dataset, shards))
    found = torch.load(shared / run / "checkpoint.pt", weights_only=True)
    assert found["done"] == 20
    assert found["penalty_weights"] == state.control.weights
    for name, value in state.model.state_dict().items():
        assert torch.allclose(value, found["model"][name], rtol=0.0, atol=TOLERANCE), name
    if state.critics is not None:
        for name, value in state.critics.state_dict().items():
            assert torch.allclose(value, found["critics"][name], rtol=0.0, atol=TOLERANCE), name
    mine, theirs = ((folder / run / "metrics.jsonl").read_text().splitlines() for folder in (tmp_path, shared))
    for one, other in zip(map(json.loads, mine), map(json.loads, theirs), strict=True):
        del one["seconds"], other["seconds"]
        assert one == pytest.approx(other, rel=1e-4)
    assert json.loads((shared / run / "versions.json").read_text())["workers"] == "2"


def test_refuses_a_batch_that_cannot_be_shared_out_and_a_folder_that_one_does_not_see(shared: Path) -> None:
    for rank in range(2):
        *batches, folder = (shared / f"refused_{rank}.txt").read_text().splitlines()
        assert batches == [
            "batch 15 is not a multiple of 2 workers",
            "batch 16 is not a multiple of 2 workers times 16 windows that share a budget",
        ]
        assert folder.startswith("workers are at updates [20, 0], expected one: they must share the folder")


def test_a_process_of_its_own_has_no_group() -> None:
    with workers.joined("cpu"):
        assert not torch.distributed.is_initialized()
        assert (workers.count(), workers.rank()) == (1, 0)
        assert workers.share(15, 1) == slice(0, 15)
        x, module = torch.ones(3), torch.nn.Linear(1, 1)
        assert workers.gather(x) is x
        assert workers.spread(module) is module
        assert workers.weigh(x, x) == 1.0
