"""Reading traces: what a dataset must be, returns-to-go, normalisation and windows."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.training import toy
from training.datasets import TracesError
from training.steps import returns_to_go
from training.traces import choose_windows, load_traces


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30))
def test_returns_to_go_is_the_sum_of_what_is_left(rewards: list[float]) -> None:
    expected = [sum(rewards[t:]) for t in range(len(rewards))]
    assert returns_to_go(np.array(rewards)).tolist() == pytest.approx(expected, abs=1e-2)


def test_reads_what_was_recorded(dataset: Path) -> None:
    traces = load_traces(dataset)
    assert traces.layout.features == toy.FEATURES
    assert len(traces.lengths_E) == 40
    assert traces.free_SF.shape == (traces.lengths_E.sum(), traces.layout.features.n_free)
    # The toy's clock counts the timesteps of each episode from 0.
    clocks = [torch.arange(int(n)).float() for n in traces.lengths_E]
    assert torch.equal(traces.free_SF[:, 1], torch.cat(clocks))
    which = traces.free_SF[:, 0] == 0
    answer = torch.sign(torch.where(which, traces.costly_SD[:, 0], traces.costly_SD[:, 2]).float())
    assert torch.equal(traces.actions_SA[:, 0], answer)


def test_windows_stay_inside_their_episode_and_mark_padding(dataset: Path) -> None:
    traces = load_traces(dataset)
    generator, starts = np.random.default_rng(0), set()
    for _ in range(20):
        batch = toy.windows(traces, 64, 12, generator)
        valid = batch.valid_BT.bool()
        assert valid[:, 0].all()
        clock = batch.free_BTF[..., 1]
        assert ((clock[:, 1:] - clock[:, :-1] == 1) | ~valid[:, 1:]).all()
        starts |= set(clock[:, 0].tolist())
    assert {0.0, 1.0} <= starts, "windows must begin at an episode's start as well as inside it"


@given(st.integers(0, 11))
def test_a_window_within_an_episode_counts_from_its_burn_in_on(dataset: Path, burn_in: int) -> None:
    windows = choose_windows(load_traces(dataset), 64, 12, np.random.default_rng(burn_in))
    for step_T, length, counted_T in zip(
        windows.step_BT, windows.length_B, windows.counted_BT(burn_in).bool().tolist(), strict=True
    ):
        first = 0 if step_T[0] == 0 else burn_in
        assert counted_T == [first <= t and step < length for t, step in enumerate(step_T)]


def test_an_episodes_ends_are_met_half_as_often_as_its_middle(dataset: Path) -> None:
    """A window of 4 in an episode of 20 starts anywhere from 2 before it to 2 before its end, then is moved into it."""
    windows = choose_windows(load_traces(dataset), 200_000, 4, np.random.default_rng(0))
    starts = windows.step_BT[windows.length_B == 20, 0]
    met = np.bincount(starts, minlength=17) / len(starts)
    assert met[0] == pytest.approx(3 / 20, rel=0.2)
    assert met[1:16] == pytest.approx(np.full(15, 1 / 20), rel=0.2)
    assert met[16] == pytest.approx(2 / 20, rel=0.2)
    met = np.bincount(windows.length_B, minlength=30)[8:]
    there = np.bincount(load_traces(dataset).lengths_E, minlength=30)[8:]
    assert met / len(windows.length_B) == pytest.approx(there * np.arange(8, 30) / (there @ np.arange(8, 30)), abs=0.01)


def test_held_out_episodes_are_never_drawn(dataset: Path) -> None:
    kept, rest = load_traces(dataset).split(0.25)
    assert (len(kept.lengths_E), len(rest.lengths_E)) == (30, 10)
    generator, boundary = np.random.default_rng(0), int(rest.starts_E[0])
    seen = torch.cat([toy.windows(kept, 64, 12, generator).costly_BTD.flatten(0, 1) for _ in range(20)])
    drawn = {tuple(row) for row in seen.tolist()}
    assert drawn <= {tuple(row) for row in kept.costly_SD[:boundary].float().tolist()}


def test_refuses_links_out_of_the_file(dataset: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    with h5py.File(bad / "data" / "main_data.hdf5", "a") as root:
        root["episode_0"]["elsewhere"] = h5py.ExternalLink("/etc/passwd", "/x")
    with pytest.raises(TracesError, match="ExternalLink, expected data"):
        load_traces(bad)


def test_refuses_groups_in_a_circle(dataset: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    with h5py.File(bad / "data" / "main_data.hdf5", "a") as root:
        root["episode_0"]["again"] = root["episode_0"]
    with pytest.raises(TracesError, match="another place"):
        load_traces(bad)


def test_refuses_a_symbolic_link(dataset: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    data = bad / "data" / "main_data.hdf5"
    data.rename(tmp_path / "elsewhere.hdf5")
    data.symlink_to(tmp_path / "elsewhere.hdf5")
    with pytest.raises(TracesError, match="symbolic link"):
        load_traces(bad)


def test_refuses_a_folder_that_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(TracesError, match="not a Minari dataset"):
        load_traces(tmp_path)


@pytest.mark.parametrize(
    ("array", "place", "value", "message"),
    [
        ("observations/costly", (2, 1), np.nan, "costly has numbers that are not finite"),
        ("observations/costly", (2, 1), -np.inf, "costly has numbers that are not finite"),
        ("observations/free", (0, 0), np.inf, "free has numbers that are not finite"),
        ("rewards", (1,), np.nan, "rewards has numbers that are not finite"),
    ],
)
def test_refuses_numbers_that_cannot_be_kept(
    dataset: Path, tmp_path: Path, array: str, place: tuple[int, ...], value: float, message: str
) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    with h5py.File(bad / "data" / "main_data.hdf5", "a") as root:
        root["episode_3"][array][place] = value
    with pytest.raises(TracesError, match=f"episode 3: {message}"):
        load_traces(bad)


@pytest.mark.parametrize("array", ["observations/free", "observations/costly", "actions"])
def test_refuses_arrays_of_different_length(dataset: Path, tmp_path: Path, array: str) -> None:
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    with h5py.File(bad / "data" / "main_data.hdf5", "a") as root:
        short = root["episode_3"][array][:5]
        del root["episode_3"][array]
        root["episode_3"][array] = short
    with pytest.raises(TracesError, match=f"episode 3: {array.split('/')[-1]} has shape"):
        load_traces(bad)


@pytest.mark.parametrize("key", ["features", "observation_space", "action_space"])
def test_refuses_metadata_that_lack_a_key(dataset: Path, tmp_path: Path, key: str) -> None:
    """Without its spaces, minari would make the environment that the metadata name: any callable there is."""
    bad = tmp_path / "bad"
    shutil.copytree(dataset, bad)
    file = bad / "data" / "metadata.json"
    metadata = json.loads(file.read_text())
    del metadata[key]
    file.write_text(json.dumps(metadata))
    with pytest.raises(TracesError, match="tells no features" if key == "features" else f"there is no '{key}'"):
        load_traces(bad)


@pytest.mark.parametrize("episodes", [0, -1])
def test_refuses_to_read_nothing(dataset: Path, episodes: int) -> None:
    with pytest.raises(TracesError, match="expected 1 or more"):
        load_traces(dataset, episodes=episodes)


def test_a_share_of_the_windows_begins_with_the_episode(dataset: Path) -> None:
    traces = load_traces(dataset)
    first_S1 = torch.zeros(len(traces.free_SF), 1)
    first_S1[torch.from_numpy(traces.starts_E)] = 1.0
    marked = replace(traces, free_SF=first_S1)
    shares = []
    for beginnings in (0.0, 0.5, 1.0):
        batch = toy.windows(marked, 2000, 3, np.random.default_rng(0), beginnings=beginnings)
        shares.append(batch.free_BTF[:, 0, 0].mean().item())
    assert shares[0] < 0.2
    assert shares[1] == pytest.approx(0.5 * (1.0 + shares[0]), abs=0.03)
    assert shares[2] == 1.0
