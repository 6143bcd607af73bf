"""What is shown while a squad plays, on a terminal and elsewhere."""

from __future__ import annotations

import io

import numpy as np
from rich.console import Console

from game.env import ACTION_SPEC, NavigationEnv
from game.live import LiveView
from game.squad import Bot, Episode
from protocol.client import Welcome
from protocol.features import CostModel

STAND_STILL = np.zeros(3, dtype=np.float32)


def played(env: NavigationEnv, console: Console) -> tuple[str, Episode]:
    """One bot ends an episode of one decision; another is in its first."""
    table = env.table
    welcome = Welcome("c", "made-up", table, ACTION_SPEC, CostModel.declared(table), 49.2, 20, 8, 1000)
    squad = [Bot(env), Bot(env)]
    query_M = np.arange(table.n_queries) < 10  # ten rays of 1 m
    with LiveView(console, squad, welcome, 3) as view:
        view.door = "http"
        for bot, decisions in zip(squad, (1, 2), strict=True):
            bot.begin(5, 0)
            env.max_decisions = decisions
            bot.cast(query_M, 25.8)
            ended = bot.advance(STAND_STILL, 0)
            view.update([] if ended is None else [ended])
        assert view.done == 1
    return console.file.getvalue(), squad[0].last


def test_a_line_an_episode_where_there_is_no_terminal(hard):
    shown, episode = played(hard, Console(file=io.StringIO(), width=120))
    assert episode.ending == "timed out"
    assert shown.splitlines() == ["  1 of 3: seed 5 timed out, return 0.0, 1 frames, 5.2 % of rays"]


def test_a_live_table_on_a_terminal(hard, monkeypatch):
    monkeypatch.setattr("game.live._REDRAW_S", -1.0)
    shown, _ = played(hard, Console(file=io.StringIO(), width=100, force_terminal=True, color_system=None))
    assert "1 of 3 episodes over http, mean return 0.0" in shown
    assert "timed out, 0.0" in shown
    assert "25.8" in shown.split("of 49.2")[-1]
    assert "████" in shown
