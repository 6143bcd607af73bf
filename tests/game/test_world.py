import math

import pytest

from game.character import JUMP_M_S, SPEED_M_S
from game.env import NavigationEnv


def _walk(env: NavigationEnv, x: float, y: float, yaw: float, decisions: int, jump: bool = False) -> bool:
    """Place the character and walk straight; True when it died."""
    env.world.character.place(x, y, yaw)
    return any(env.world.advance(0.0, 1.0, jump) for _ in range(decisions))


def _standing_and_broken(env: NavigationEnv, river: int) -> tuple[float, float]:
    """y of a standing bridge and of a slot without one, in the present episode."""
    slots, standing = env.terrain.rivers[river].slots, env.layout.bridges[river]
    middle = [(slot[1] + slot[3]) / 2 for slot in slots]
    return middle[standing.index(True)], middle[standing.index(False)]


def test_the_character_walks_turns_and_stands_on_the_ground(hard):
    hard.restart(seed=0)
    character = hard.world.character
    character.place(-32.0, 0.0, 0.0)
    for _ in range(10):
        assert not hard.world.advance(0.0, 0.5, False)
    assert character.x == pytest.approx(-32.0 + 0.5 * SPEED_M_S, abs=0.05)
    assert character.z == pytest.approx(0.0, abs=0.03)
    assert character.on_ground
    hard.world.advance(1.0, 0.0, False)
    assert character.yaw == pytest.approx(math.radians(30.0))


def test_a_jump_is_about_four_metres_and_ignored_in_the_air(easy):
    easy.restart(seed=0)
    character = easy.world.character
    character.place(-20.0, 20.0, 0.0)
    heights, airborne = [], 0
    for _ in range(12):
        easy.world.advance(0.0, 1.0, len(heights) < 6)
        heights.append(character.z)
        airborne += not character.on_ground
    assert max(heights) == pytest.approx(JUMP_M_S**2 / 2 / 9.81, abs=0.06)
    assert 3.0 <= airborne * 0.1 * SPEED_M_S <= 4.5


@pytest.mark.parametrize("river", [0, 1])
@pytest.mark.parametrize("jump", [False, True])
def test_a_river_kills_and_cannot_be_jumped(hard, river, jump):
    hard.restart(seed=1)
    _, broken_y = _standing_and_broken(hard, river)
    bank_x = hard.terrain.rivers[river].rect[0]
    for run_up_m in (0.3, 1.0, 2.2, 3.1):
        assert _walk(hard, bank_x - run_up_m, broken_y, 0.0, 30, jump)


@pytest.mark.parametrize("river", [0, 1])
def test_a_standing_bridge_carries(hard, river):
    hard.restart(seed=1)
    standing_y, _ = _standing_and_broken(hard, river)
    rect = hard.terrain.rivers[river].rect
    assert not _walk(hard, rect[0] - 1.0, standing_y, 0.0, 16)
    assert hard.world.character.x > rect[2]


def test_pools_kill_where_this_episode_drew_them(hard):
    hard.restart(seed=2)
    pools = hard.layout.pools
    assert pools
    for pool in pools:
        x, y = (pool.rect[0] + pool.rect[2]) / 2, (pool.rect[1] + pool.rect[3]) / 2
        hard.world.character.place(x, y, 0.0)
        assert hard.world.advance(0.0, 0.0, False)
    hard.restart(seed=3)
    gone = [pool for pool in pools if not any(_inside(pool.rect, rect) for rect in hard.layout.deadly)]
    assert gone
    for pool in gone:
        hard.world.character.place((pool.rect[0] + pool.rect[2]) / 2, (pool.rect[1] + pool.rect[3]) / 2, 0.0)
        assert not hard.world.advance(0.0, 0.0, False)


def _inside(inner, outer) -> bool:
    x, y = (inner[0] + inner[2]) / 2, (inner[1] + inner[3]) / 2
    return outer[0] <= x <= outer[2] and outer[1] <= y <= outer[3]


@pytest.mark.parametrize(("jump", "crosses"), [(False, False), (True, True)])
def test_a_ledge_needs_a_jump(hard, jump, crosses):
    hard.restart(seed=0)
    ledge = hard.terrain.ledges[0].rect
    _walk(hard, ledge[0] - 3.0, -28.0, 0.0, 18, jump)
    assert (hard.world.character.x > ledge[0]) == crosses


def test_walls_stop(hard):
    hard.restart(seed=0)
    wall = hard.terrain.walls[1].rect
    _walk(hard, wall[0] - 2.0, 0.0, 0.0, 15)
    assert hard.world.character.x < wall[0]
    half_x = hard.terrain.size_m[0] / 2
    _walk(hard, half_x - 2.0, 0.0, 0.0, 15)
    assert hard.world.character.x < half_x
