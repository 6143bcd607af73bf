"""The same sweep on a Ray that is started for the test: no stand-in for a cluster."""

from __future__ import annotations

import importlib.util
import sys
import time
from pathlib import Path

import pytest

from bot_runtime.bundle import Bundle
from tests.training.sweeps import write_spec
from training import sweep_run
from training.sweep import SweepConfig, _executor, sweep
from training.sweep_spec import SweepSpec

needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed")
pytestmark = [
    pytest.mark.filterwarnings("default"),  # what Ray's own modules warn of is no fault of ours
    pytest.mark.timeout(300),  # each run imports torch and exports: long on a busy machine
]


@needs_ray
def test_a_sweep_on_a_real_ray(dataset: Path, tmp_path: Path) -> None:
    spec = write_spec(tmp_path, dataset, [{"seed": [0, 1]}, {"dataset": str(tmp_path / "nothing")}])
    config = SweepConfig(spec, workers=2, threads=1, ray="local")
    outcomes = sweep(config)
    assert [outcome.state for outcome in outcomes] == ["done", "done", "failed"]
    assert "nothing" in outcomes[2].reason
    for outcome in outcomes[:2]:
        assert Bundle.load(outcome.run.bundle).name == outcome.run.name
    assert [outcome.state for outcome in sweep(SweepConfig(spec, ray="local", only="*test-v0*"))] == ["done before"] * 2


@needs_ray
def test_no_run_outlives_a_sweep_on_ray(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaving as Ctrl-C does ends the run, and what waits is never begun."""
    monkeypatch.setattr(sweep_run, "_LOCK_S", 0.0)
    spec = write_spec(tmp_path, dataset, [{"seed": [0, 1]}], updates=10**6, checkpoint_every=1)
    running, waiting = SweepSpec.read(spec).runs()
    with _executor(SweepConfig(spec, workers=1, threads=1, ray="local")) as submit:
        futures = [submit(running), submit(waiting)]
        while not (running.config.out / "checkpoint.pt").exists():
            assert not any(future.done() for future in futures)
            time.sleep(0.05)
    with (running.config.out / "log.txt").open("ab") as log:
        assert sweep_run._lock(log)
    assert not waiting.config.out.exists()


@needs_ray
def test_more_than_the_cluster_has_is_refused(dataset: Path, tmp_path: Path) -> None:
    config = SweepConfig(write_spec(tmp_path, dataset, [{}]), workers=1, threads=1, ray="local", gpus_per_run=1000.0)
    with pytest.raises(ValueError, match="asks Ray for 1000 GPU"):
        sweep(config)


def test_without_ray_says_what_to_install(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="not installed: pip install 'ray"):
        sweep(SweepConfig(write_spec(tmp_path, dataset, [{}]), ray="local"))
