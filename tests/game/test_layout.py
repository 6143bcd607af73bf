import math

import numpy as np
import pytest

from game.grid import Grid
from game.layout import draw_layout, open_stretches
from game.terrain import MapError, River, load_map, overlaps

_SEEDS = range(40)


def test_the_seed_decides():
    terrain = load_map("hard")
    first, again, other = (draw_layout(terrain, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert first == again
    assert first != other


def test_bridges_and_pools_differ_between_seeds_and_every_slot_is_used():
    terrain = load_map("hard")
    layouts = [draw_layout(terrain, np.random.default_rng(seed)) for seed in _SEEDS]
    assert len({layout.bridges for layout in layouts}) > 20
    assert len({layout.pools for layout in layouts}) == len(layouts)
    for r, river in enumerate(terrain.rivers):
        standing = np.array([layout.bridges[r] for layout in layouts])
        assert (standing.sum(axis=1) == river.standing).all()
        assert standing.any(axis=0).all()


@pytest.mark.parametrize("name", ["easy", "hard"])
def test_every_goal_can_be_reached_on_foot_half_a_metre_from_danger(name):
    terrain = load_map(name)
    grid = Grid(terrain)
    for seed in _SEEDS:
        layout = draw_layout(terrain, np.random.default_rng(seed))
        costs_HW = grid.empty()
        costs_HW[grid.inside(wall.rect for wall in terrain.walls)] = np.inf
        costs_HW[grid.inside(layout.deadly, 0.5)] = np.inf
        start, goal = grid.cell(*layout.start), grid.cell(*layout.goal)
        assert math.isfinite(grid.cost_to_go(costs_HW.ravel().tolist(), goal, start)[start])


def test_pools_keep_clear_of_start_goal_walls_and_each_other():
    terrain = load_map("hard")
    for seed in _SEEDS:
        layout = draw_layout(terrain, np.random.default_rng(seed))
        for i, pool in enumerate(layout.pools):
            assert not any(overlaps(pool.rect, (*point, *point), 3.0) for point in (layout.start, layout.goal))
            assert not any(overlaps(pool.rect, wall.rect) for wall in terrain.walls)
            assert not any(overlaps(pool.rect, other.rect) for other in layout.pools[:i])


@pytest.mark.parametrize("along", ["y", "x"])
def test_open_stretches_are_the_river_less_its_bridges(along):
    def turned(rect):
        return rect if along == "y" else (rect[1], rect[0], rect[3], rect[2])

    river = River("lava", turned((0, -10, 6, 10)), tuple(turned(slot) for slot in [(0, 4, 6, 8), (0, -10, 6, -6)]), 1)
    assert open_stretches(river, (False, False)) == [river.rect]
    assert open_stretches(river, (True, False)) == [turned((0, -10, 6, 4)), turned((0, 8, 6, 10))]
    assert open_stretches(river, (True, True)) == [turned((0, -6, 6, 4)), turned((0, 8, 6, 10))]


def test_a_map_that_cannot_be_crossed_is_the_maps_fault():
    terrain = load_map("hard")
    wall = type(terrain.walls[0])((-1.0, -30.0, 1.0, 30.0), 3.0)
    cut = type(terrain)(**{**{name: getattr(terrain, name) for name in terrain.__struct_fields__}, "walls": (wall,)})
    with pytest.raises(MapError, match="no goal could be reached"):
        draw_layout(cut, np.random.default_rng(0))


def test_start_and_goal_are_never_the_same_place():
    terrain = load_map("easy")
    trip = type(terrain.trips[0])((-28.0, -5.0, -20.0, 5.0), (-28.0, -5.0, -20.0, 5.0))
    fields = {name: getattr(terrain, name) for name in terrain.__struct_fields__}
    near = type(terrain)(**{**fields, "trips": (trip,)})
    for seed in _SEEDS:
        layout = draw_layout(near, np.random.default_rng(seed))
        assert math.dist(layout.start, layout.goal) >= 5.0
