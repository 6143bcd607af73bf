"""What a checkpoint tells export: the recorded episode, and the return to ask for."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.training import toy
from tests.training.test_sink import most_bytes_of_a_file
from training.checkpoint import Facts, load_checkpoint, load_trained
from training.traces import load_traces
from training.train import train
from training.update import new_state


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


def test_a_run_whose_features_changed_does_not_go_on(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=4)
    train(config)
    dearer = tmp_path / "dearer-v0"
    shutil.copytree(dataset, dearer)
    file = dearer / "data" / "metadata.json"
    file.write_text(file.read_text().replace('\\"cost_us\\":2.0', '\\"cost_us\\":20.0'))
    traces = load_traces(dearer)
    with pytest.raises(ValueError, match="trained with other features, costs or actions"):
        load_checkpoint(tmp_path / "run" / "checkpoint.pt", config, new_state(config, traces), traces.layout)
    with pytest.raises(ValueError, match="is of update 4, expected at most updates 2"):
        train(dataclasses.replace(config, updates=2))


@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_what_is_no_whole_checkpoint_is_named(dataset: Path, tmp_path: Path, content: bytes | None) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=2)
    train(config)
    file = tmp_path / "run" / "checkpoint.pt"
    file.write_bytes(file.read_bytes()[:5000] if content is None else content)
    for read in (lambda: load_trained(file), lambda: train(dataclasses.replace(config, updates=4))):
        with pytest.raises(ValueError, match=r"checkpoint\.pt is no whole checkpoint"):
            read()


def test_a_full_disk_keeps_the_checkpoint_before(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=2)
    train(config)
    before = (tmp_path / "run" / "checkpoint.pt").read_bytes()
    with most_bytes_of_a_file(20_000), pytest.raises(OSError, match="too large"):
        train(dataclasses.replace(config, updates=4))
    assert (tmp_path / "run" / "checkpoint.pt").read_bytes() == before
    assert not list((tmp_path / "run").glob("*.partial"))
    assert train(dataclasses.replace(config, updates=4)).done == 4
