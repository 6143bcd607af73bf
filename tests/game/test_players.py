import math
from types import SimpleNamespace

import numpy as np
import pytest

from game.beliefs import Beliefs
from game.grid import Grid
from game.players import Kicks, Player
from game.skills import EXPERT, GROUNDED, INTERMEDIATE, NEARSIGHTED, Skill


def _returns(env, skill, seeds, kick_chance=0.1) -> list[float]:
    player = Player(skill, env.terrain)
    totals = []
    for seed in seeds:
        env.restart(seed=seed)
        rng = np.random.default_rng([seed, 1])
        player.start(env.layout, rng)
        kicks = Kicks(rng, kick_chance)
        total, over = 0.0, False
        while not over:
            intended = player.act(env.world.character)
            assert env.action_space.contains(intended)
            reward, terminated, truncated, _ = env.advance(kicks.executed(intended, env))
            total, over = total + reward, terminated or truncated
        totals.append(total)
    return totals


@pytest.mark.parametrize(("skill", "least"), [(EXPERT, 95.0), (NEARSIGHTED, 90.0), (GROUNDED, 85.0)])
def test_experts_arrive_although_they_are_kicked(hard, skill: Skill, least: float):
    assert np.mean(_returns(hard, skill, range(20))) >= least


@pytest.mark.parametrize(("on_ground", "z", "sees"), [(True, 0.0, True), (True, 0.6, False), (False, 0.1, False)])
def test_a_grounded_player_sees_nothing_new_from_a_ledge_or_the_air(hard, on_ground: bool, z: float, sees: bool):
    hard.restart(seed=0)
    x0, y0, _, y1 = hard.layout.pools[0].rect
    before = SimpleNamespace(x=x0 - 2.0, y=(y0 + y1) / 2, z=z, yaw=0.0, on_ground=on_ground)
    for skill, expected in ((GROUNDED, sees), (NEARSIGHTED, True)):
        beliefs = Beliefs(hard.terrain, Grid(hard.terrain), hard.layout, skill, np.random.default_rng(0))
        assert beliefs.look(before) == expected


def test_a_grounded_player_takes_ledges_carefully(hard):
    hard.restart(seed=0)
    player, who = Player(GROUNDED, hard.terrain), hard.world.character
    player.start(hard.layout, np.random.default_rng(0))
    aloft, over = [], False
    while not over:
        action = player.act(who)
        if who.z > 0.3:
            aloft.append(action[1])
        _, terminated, truncated, _ = hard.advance(action)
        over = terminated or truncated
    assert aloft
    assert max(aloft) <= np.float32(GROUNDED.careful_speed)


def test_the_intermediate_is_worse_and_not_hopeless(hard):
    assert 30.0 <= np.mean(_returns(hard, INTERMEDIATE, range(20))) <= 80.0


def test_two_episodes_of_one_layout_take_different_ways(hard):
    paths = []
    for mood in (0, 1):
        hard.restart(seed=0)
        player = Player(EXPERT, hard.terrain)
        player.start(hard.layout, np.random.default_rng(mood))
        path = []
        for _ in range(80):
            hard.advance(player.act(hard.world.character))
            path.append((hard.world.character.x, hard.world.character.y))
        paths.append(np.array(path))
    assert np.abs(paths[0] - paths[1]).max() > 0.5


def test_a_player_knows_nothing_of_a_bridge_it_has_not_seen(hard):
    """Until something comes into view, episodes that differ only in their draws get the same actions."""
    from dataclasses import replace

    hard.restart(seed=0)
    layout = hard.layout
    other = replace(layout, bridges=tuple(standing[::-1] for standing in layout.bridges), pools=())
    actions = []
    for truth in (layout, other):
        player = Player(EXPERT, hard.terrain)
        player.start(truth, np.random.default_rng(0))
        hard.world.place(layout)
        actions.append(player.act(hard.world.character))
    np.testing.assert_array_equal(*actions)


def test_jump_is_pressed_before_a_ledge_and_nowhere_else(hard):
    hard.restart(seed=0)
    player = Player(EXPERT, hard.terrain)
    ledge = hard.terrain.ledges[0].rect
    for before_m, pressed in ((4.0, False), (1.2, True), (0.4, True)):
        player.start(hard.layout, np.random.default_rng(0))
        hard.world.character.place(ledge[0] - before_m, 0.0, 0.0)
        heading_east = hard.layout.goal[0] > 0
        hard.world.character.place(
            ledge[0] - before_m if heading_east else ledge[2] + before_m, 0.0, 0.0 if heading_east else math.pi
        )
        assert bool(player.act(hard.world.character)[2] > 0.5) == pressed


def test_kicks_change_what_is_executed_and_only_turn_at_the_brink(hard):
    hard.restart(seed=0)
    intended = np.array([0.0, 1.0, 0.0], dtype=np.float32)
    always = Kicks(np.random.default_rng(0), chance=1.0)
    hard.world.character.place(-32.0, 0.0, math.pi / 2)
    assert not np.array_equal(always.executed(intended, hard), intended)
    assert always.executed(intended, hard)[1] > 0.0
    hard.world.character.place(-15.3, hard.layout.goal[1], 0.0)
    hard.world._deadly = ((-15.0, -30.0, 15.0, 30.0),)
    at_the_brink = np.stack([always.executed(intended, hard) for _ in range(50)])
    assert (at_the_brink[:, 1:] == 0.0).all()
    assert at_the_brink[:, 0].min() < -0.5 < 0.5 < at_the_brink[:, 0].max()
    never = Kicks(np.random.default_rng(0), chance=0.0)
    assert never.executed(intended, hard) is intended


@pytest.mark.parametrize("skill", [EXPERT, NEARSIGHTED, INTERMEDIATE])
def test_players_are_reproducible(hard, skill):
    assert _returns(hard, skill, range(2)) == _returns(hard, skill, range(2))
