import multiprocessing
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from game.env import ACTION_SPEC, REACH_M, NavigationEnv
from game.players import Player
from game.skills import EXPERT


def _trace(map_name: str, seed: int, decisions: int) -> np.ndarray:
    """Everything seen and earned in an episode of fixed, varied actions, flattened."""
    env = NavigationEnv(map_name)
    trace = _play(env, seed, decisions)
    env.close()
    return trace


def _play(env: NavigationEnv, seed: int, decisions: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    rows = [np.concatenate([observation["free"], observation["costly"], [0.0]])]
    for _ in range(decisions):
        action = rng.uniform([-1, 0, 0], [1, 1, 1]).astype(np.float32)
        observation, reward, terminated, _, _ = env.step(action)
        rows.append(np.concatenate([observation["free"], observation["costly"], [reward]]))
        if terminated:
            break
    return np.stack(rows)


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_gymnasiums_own_checker_has_nothing_to_say(name):
    env = gymnasium.make("game.env:Navigation-v0", map=name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_the_same_seed_and_actions_give_the_same_episode_after_any_other(hard):
    first = _play(hard, 11, 60)
    _play(hard, 12, 30)
    np.testing.assert_array_equal(first, _play(hard, 11, 60))


def test_the_same_episode_in_another_process():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.apply(_trace, ("hard", 11, 60))
    np.testing.assert_array_equal(elsewhere, _trace("hard", 11, 60))


def _expert_episode(env: NavigationEnv, seed: int) -> tuple[float, dict, bool, bool]:
    env.restart(seed=seed)
    player = Player(EXPERT, env.terrain)
    player.start(env.layout, np.random.default_rng(seed))
    total, terminated, truncated = 0.0, False, False
    while not (terminated or truncated):
        reward, terminated, truncated, info = env.advance(player.act(env.world.character))
        assert reward >= 0.0
        total += reward
    return total, info, terminated, truncated


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_rewards_of_an_episode_that_arrives_sum_to_100(name, request):
    total, info, terminated, truncated = _expert_episode(request.getfixturevalue(name), 0)
    assert total == pytest.approx(100.0, abs=1e-6)
    assert info["reached"]
    assert not info["died"]
    assert info["distance_m"] <= REACH_M
    assert terminated
    assert not truncated


def test_death_terminates_and_earns_nothing_on_its_last_step(hard):
    hard.restart(seed=1)
    pool = hard.layout.pools[0].rect
    hard.world.character.place(pool[0] + 1.0, pool[1] + 1.0, 0.0)
    reward, terminated, truncated, info = hard.advance(ACTION_SPEC.safe)
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["died"]
    assert not info["reached"]


def test_time_out_truncates():
    env = NavigationEnv("easy", max_decisions=5)
    env.reset(seed=0)
    ends = [env.advance(ACTION_SPEC.safe)[1:3] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]
    env.close()


def test_walking_away_and_back_earns_nothing(easy):
    easy.restart(seed=0)
    easy.world.character.yaw += np.pi - easy.layout.start_yaw  # the goal lies east
    total = sum(easy.advance(np.array(action, dtype=np.float32))[0] for action in [(0, 1, 0)] * 4)
    total += sum(easy.advance(np.array((1, 0, 0), dtype=np.float32))[0] for _ in range(6))
    total += sum(easy.advance(np.array((0, 1, 0), dtype=np.float32))[0] for _ in range(3))
    assert total == 0.0


def test_free_features_say_where_the_goal_lies_in_the_body_frame(hard):
    hard.restart(seed=4)
    free = hard.observe_free()
    position, (cos, sin), goal, relative = free[:3], free[3:5], free[8:11], free[11:14]
    world = position[:2] + np.array([cos * relative[0] - sin * relative[1], sin * relative[0] + cos * relative[1]])
    np.testing.assert_allclose(world, goal[:2], atol=1e-4)
    hard.world.character.yaw = float(np.arctan2(goal[1] - position[1], goal[0] - position[0]))
    ahead, left, _ = hard.observe_free()[11:14]
    assert ahead > 40.0
    assert left == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_declared_ranges_hold_whatever_is_done(name, request):
    env = request.getfixturevalue(name)
    (free_low, free_high), (costly_low, costly_high) = env.table.free_range, env.table.costly_range
    for seed in range(6):
        rows = _play(env, 100 + seed, 60)
        free, costly = rows[:, : env.table.n_free], rows[:, env.table.n_free : -1]
        assert ((free >= free_low) & (free <= free_high)).all()
        assert ((costly >= costly_low) & (costly <= costly_high)).all()


def test_actions_out_of_range_are_clipped(easy):
    easy.restart(seed=0)
    before = easy.world.character.yaw
    easy.advance(np.array([9.0, -3.0, 0.0], dtype=np.float32))
    assert easy.world.character.yaw - before == pytest.approx(np.radians(30.0))
    assert easy.observe_free()[5:7] == pytest.approx([0.0, 0.0], abs=1e-3)


def test_stepping_before_reset_is_refused():
    env = NavigationEnv("easy")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(ACTION_SPEC.safe)
    env.close()
