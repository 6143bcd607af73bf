"""Frames whose action cannot be told without costly features count more."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training import toy
from training.checkpoint import load_trained
from training.keyframes import weigh_keyframes
from training.traces import choose_windows, load_traces, read_windows
from training.train import train


@pytest.fixture(scope="module")
def blind(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that acquires nothing: it cannot know the push, and knows that it never waits."""
    out = tmp_path_factory.mktemp("blind")
    train(toy.config(dataset, out, acquisition="none", updates=60, learning_rate=5e-3))
    return out


def test_the_worse_a_frame_is_told_the_more_it_counts(dataset: Path, blind: Path) -> None:
    traces = load_traces(dataset)
    weights_S = weigh_keyframes(blind, traces).weights_S
    assert weights_S is not None
    assert weights_S.mean().item() == pytest.approx(1.0, abs=1e-4)
    assert weights_S.max() / weights_S.min() <= (0.3 + 0.7 * 4.0) / 0.3 + 1e-4
    first = slice(int(traces.starts_E[3]), int(traces.starts_E[3] + traces.lengths_E[3]))
    model, steps = load_trained(blind / "checkpoint.pt").model, traces.episode(3)
    togo = steps.returns_to_go_T[None, :, None]
    with torch.no_grad():
        known = model.know(steps.free_TF[None], togo, torch.zeros_like(togo), steps.costly_TD[None].float())
        hidden = model.hiddens(known, torch.zeros(1, len(togo[0]), model.config.n_queries))
        losses = model.action_head.losses(hidden, steps.actions_TA[None])[0]
    order = losses.argsort()
    assert (weights_S[first][order].diff() >= -1e-6).all()
    assert weights_S[first].std() > 0.01, "no frame is surer than another"


def test_a_frame_that_nothing_explains_counts_no_more_than_four_mean_ones(dataset: Path, blind: Path) -> None:
    """Nobody ever waits: a network that has learned so finds a wait ever less likely than all else."""
    traces = load_traces(dataset)
    waited = [3, 20, 41]
    traces.actions_SA[waited, 1] = 1.0
    weights_S = weigh_keyframes(blind, traces).weights_S
    assert weights_S is not None
    assert weights_S[waited].tolist() == [weights_S.max().item()] * 3
    assert (weights_S == weights_S.max()).sum() == 3


def test_windows_carry_their_weights(dataset: Path, blind: Path) -> None:
    traces = weigh_keyframes(blind, load_traces(dataset))
    windows = choose_windows(traces, 4, 6, np.random.default_rng(0))
    batch, plain = read_windows(traces, windows), read_windows(load_traces(dataset), windows)
    assert (plain.weight_BT == 1.0).all()
    assert traces.weights_S is not None
    first = int(windows.first_B[2] + windows.step_BT[2, 0])
    assert batch.weight_BT[2, 0] == traces.weights_S[first]


def test_held_out_episodes_are_not_weighed(dataset: Path, blind: Path) -> None:
    kept, _ = load_traces(dataset).split(0.25)
    weighed = weigh_keyframes(blind, kept)
    assert weighed.weights_S is not None
    inside = int(kept.lengths_E.sum())
    assert weighed.weights_S[:inside].mean().item() == pytest.approx(1.0, abs=1e-4)


def test_a_run_learns_from_weighed_frames(dataset: Path, blind: Path, tmp_path: Path) -> None:
    plain = train(toy.config(dataset, tmp_path / "plain", updates=3))
    weighed = train(toy.config(dataset, tmp_path / "weighed", updates=3, keyframes=blind))
    name = "action_head.weight"
    assert not torch.equal(plain.model.state_dict()[name], weighed.model.state_dict()[name])


def test_refuses_a_run_that_is_not_blind(
    dataset: Path, trained: tuple[Path, object], blind: Path, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"has acquisition learned and bins .* expected none"):
        weigh_keyframes(trained[0], load_traces(dataset))
    with pytest.raises(FileNotFoundError, match="does not exist"):
        train(toy.config(dataset, tmp_path / "run", updates=1, keyframes=tmp_path / "nowhere"))
