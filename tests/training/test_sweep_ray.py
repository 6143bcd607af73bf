"""The same sweep on a Ray that is started for the test: no stand-in for a cluster."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from bot_runtime.bundle import Bundle
from tests.training.sweeps import write_spec
from training.sweep import SweepConfig, sweep


@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed: pip install 'ray>=2.40'")
@pytest.mark.filterwarnings("default")  # what Ray's own modules warn of is no fault of ours
def test_a_sweep_on_a_real_ray(dataset: Path, tmp_path: Path) -> None:
    spec = write_spec(tmp_path, dataset, [{"seed": [0, 1]}, {"dataset": str(tmp_path / "nothing")}])
    config = SweepConfig(spec, workers=2, threads=1, ray="local")
    outcomes = sweep(config)
    assert [outcome.state for outcome in outcomes] == ["done", "done", "failed"]
    assert "nothing" in outcomes[2].detail
    for outcome in outcomes[:2]:
        assert Bundle.load(outcome.run.bundle).name == outcome.run.name
    assert [outcome.state for outcome in sweep(SweepConfig(spec, ray="local", only="*test-v0*"))] == ["done before"] * 2


def test_without_ray_says_what_to_install(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match="not installed: pip install 'ray"):
        sweep(SweepConfig(write_spec(tmp_path, dataset, [{}]), ray="local"))
