"""What a checkpoint tells export: the recorded episode, and the return to ask for."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from training.checkpoint import Facts, load_trained
from training.traces import load_traces


def test_a_turns_reward_is_the_one_since_the_turn_before(dataset: Path) -> None:
    """What an engine that plays the recorded episode would send, and what training told the network at each turn."""
    traces = load_traces(dataset)
    longest = int(traces.lengths_E.argmax())
    steps = slice(int(traces.starts_E[longest]), int(traces.starts_E[longest] + traces.lengths_E[longest]))
    golden = Facts.of(traces, None).golden
    with h5py.File(dataset / "data" / "main_data.hdf5") as root:
        recorded = root[f"episode_{longest}"]["rewards"][:]
    assert golden["rewards"][0] == 0.0
    assert golden["rewards"][1:].tolist() == pytest.approx(recorded[:-1].tolist(), abs=1e-5)
    told = traces.episode_returns_E[longest] - golden["rewards"].cumsum(0)
    assert torch.allclose(told, traces.returns_to_go_S[steps], atol=1e-5)
    assert torch.equal(golden["free"], traces.free_SF[steps])


def test_the_return_asked_for_is_the_90th_percentile_unless_it_is_given(dataset: Path) -> None:
    traces = load_traces(dataset)
    asked = Facts.of(traces, None).target_return
    assert np.mean(traces.episode_returns_E < asked) == pytest.approx(0.9, abs=1.5 / 40)
    assert Facts.of(traces, 7.0).target_return == 7.0


def test_a_run_without_a_checkpoint_says_when_one_is_written(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="does not exist: training writes it every checkpoint_every updates"):
        load_trained(tmp_path / "checkpoint.pt")
