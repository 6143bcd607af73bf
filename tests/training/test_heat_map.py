"""The heat map is a plain mean over the episodes alive, in whatever order they are counted."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.heat_map import HeatMap, HeatSums

N_QUERIES = 3
NAMES = ("near", "mid", "far")
COSTS = np.array([1.0, 2.0, 4.0])


def counted(episodes: list[np.ndarray]) -> HeatSums:
    """Count whole episodes, each probs [T, M], a timestep at a time."""
    sums = HeatSums(N_QUERIES)
    for t in range(max(len(episode) for episode in episodes)):
        alive = [episode for episode in episodes if len(episode) > t]
        sums.add(np.full(len(alive), t), np.stack([episode[t] for episode in alive]))
    return sums


@given(st.lists(st.sampled_from([1, 2, 5, 260]), min_size=1, max_size=5), st.integers(1, 4))
def test_is_the_mean_over_the_episodes_alive_however_they_are_grouped(lengths: list[int], cut: int) -> None:
    random = np.random.default_rng(len(lengths))
    episodes = [random.random((length, N_QUERIES)) for length in lengths]
    sums = HeatSums(N_QUERIES)
    for part in (episodes[:cut], episodes[cut:]):
        if part:
            sums.merge(counted(part))
    heat = sums.mean(COSTS, NAMES)
    assert heat.probs_TM.shape == (max(lengths), N_QUERIES)
    for t in range(max(lengths)):
        alive = [episode[t] for episode in episodes if len(episode) > t]
        assert heat.alive_T[t] == len(alive)
        np.testing.assert_allclose(heat.probs_TM[t], np.mean(alive, axis=0), rtol=1e-6)


def test_reads_what_it_wrote(tmp_path: Path) -> None:
    heat = counted([np.full((4, N_QUERIES), 0.25)]).mean(COSTS, NAMES)
    heat.write(tmp_path / "heat_map.npz")
    again = HeatMap.read(tmp_path / "heat_map.npz")
    assert again.names == NAMES
    for name in ("probs_TM", "alive_T", "costs_M"):
        np.testing.assert_array_equal(getattr(again, name), getattr(heat, name))
    assert again.probs_TM.dtype == np.float32


def test_refuses_what_is_no_heat_map(tmp_path: Path) -> None:
    path = tmp_path / "heat_map.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="is no heat map, expected"):
        HeatMap.read(path)
    heat = counted([np.full((4, N_QUERIES), 0.25)]).mean(COSTS, NAMES)
    heat.write(path)
    whole = path.read_bytes()
    numbers = io.BytesIO()
    np.save(numbers, heat.probs_TM)
    for broken in (whole[: len(whole) // 2], whole.replace(whole[60:70], bytes(10)), numbers.getvalue()):
        path.write_bytes(broken)
        with pytest.raises(ValueError, match="is no heat map, expected"):
            HeatMap.read(path)
    heat._replace(alive_T=heat.alive_T[:2]).write(path)
    with pytest.raises(ValueError, match=r"expected \[\[T, M\]"):
        HeatMap.read(path)
