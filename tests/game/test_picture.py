"""Pictures of whatever happened, also when little did."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imread

from game.env import feature_table
from game.layout import draw_layout
from game.picture import draw_picture, shown_episode
from game.squad import Episode
from game.terrain import Terrain, load_map
from protocol.features import CostModel

TABLE = feature_table()


def episode(terrain: Terrain, turns: int, *, reached: bool = False, died: bool = False, asked: float = 0.1) -> Episode:
    rng = np.random.default_rng(turns)
    nan_T = np.full(turns, np.nan)
    path_m = rng.uniform(-20, 20, (turns + 1, 2))
    queries_TM = rng.random((turns, TABLE.n_queries)) < asked
    return Episode(turns, draw_layout(terrain, rng), 1.0, reached, died, path_m, queries_TM, nan_T, nan_T, 0, nan_T)


def test_the_shown_episode_is_the_median_of_those_that_arrived():
    terrain = load_map("easy")
    arrived = [episode(terrain, turns, reached=True) for turns in (9, 2, 30)]
    lost = [episode(terrain, turns, died=True) for turns in (1, 12, 400)]
    assert shown_episode([*lost, *arrived]).turns == 9
    assert shown_episode(lost).turns == 12


@pytest.mark.parametrize(
    ("name", "turns", "asked", "budget_us"),
    [
        ("easy", 1, 0.0, 0.0),  # over at once, without a ray
        ("hard", 40, 1.0, 492.0),  # everything, all the time
    ],
)
def test_it_can_be_drawn(name, turns, asked, budget_us, tmp_path):
    terrain = load_map(name)
    episodes = [episode(terrain, turns, reached=True, asked=asked), episode(terrain, 3, died=True), episode(terrain, 4)]
    draw_picture(tmp_path / "p.png", terrain, episodes, CostModel.declared(TABLE), budget_us, "made-up")
    pixels = imread(tmp_path / "p.png")
    assert pixels.shape[:2] == (792, 1650)
    assert len(np.unique(pixels[:, :, 0])) > 50
