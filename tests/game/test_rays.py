import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from game.character import EYE_M
from game.env import feature_table
from game.rays import CLASSES, RANGES_M, RAY_SIZE, RAYS, cost_model, load_costs

_RANGE_M = np.array([ray.range_m for ray in RAYS], dtype=np.float32)


def _everything(env) -> np.ndarray:
    """[96, 6] values of all rays."""
    return env.cast(np.ones(len(RAYS), dtype=bool)).reshape(len(RAYS), RAY_SIZE)


def _looking(env, x: float, y: float, yaw: float) -> np.ndarray:
    env.world.character.place(x, y, yaw)
    return _everything(env)


def test_there_are_96_rays_with_the_ranges_of_the_paper_and_names_that_tell():
    assert len(RAYS) == len({ray.name for ray in RAYS}) == 96
    assert {ray.range_m for ray in RAYS} == set(RANGES_M)
    assert all(re.fullmatch(r"ray_[lr]\d{3}_[du]\d{2}_r\d{3}", ray.name) for ray in RAYS)
    assert "ray_l075_d08_r010" in {ray.name for ray in RAYS}


def test_the_default_costs_are_the_six_figures_of_the_paper():
    costs = load_costs()
    assert costs.range_us == {1: 2.58, 5: 4.27, 10: 5.14, 25: 5.37, 50: 5.49, 100: 7.9}
    assert cost_model(costs).full_us == pytest.approx(16 * 30.75)
    assert feature_table().costs_us.sum() == pytest.approx(16 * 30.75)


def test_costs_without_a_range_are_refused(tmp_path):
    path = tmp_path / "few.json"
    path.write_text('{"source": "x", "call_us": 1, "range_us": {"1": 1.0}}')
    with pytest.raises(ValueError, match=r"lack the ranges \[5, 10, 25, 50, 100\]"):
        load_costs(str(path))


def test_every_ray_hits_one_class_at_a_distance_within_its_range_and_never_its_own_body(hard):
    histogram_MC = np.zeros((len(RAYS), len(CLASSES)))
    rng = np.random.default_rng(0)
    for seed in range(20):
        hard.restart(seed=seed)
        for _ in range(10):
            values = _looking(hard, rng.uniform(-35, 35), rng.uniform(-29, 29), rng.uniform(-3, 3))
            assert (values[:, 1:].sum(axis=1) == 1.0).all()
            assert (values[:, 0] <= _RANGE_M).all()
            missed = values[:, 1] == 1.0
            assert (values[missed, 0] == _RANGE_M[missed]).all()
            histogram_MC += values[:, 1:]
    share_RC = histogram_MC.reshape(6, 16, 5).mean(axis=1) / histogram_MC[0].sum()
    nothing, ground, wall, lava, water = share_RC.T
    assert nothing[0] > 0.8  # 1 m rays seldom meet anything; hits here would be the own capsule
    assert (nothing[1:] < 0.2).all()
    assert (ground[1:5] > 0.3).all()
    assert (lava[1:5] > 0.03).all()
    assert (water[1:5] > 0.03).all()
    assert wall[5] > 0.95  # level rays end at the walls


def test_no_ray_is_stopped_at_its_origin(hard):
    hard.restart(seed=0)
    for yaw in np.linspace(-3.1, 3.1, 9):
        assert (_looking(hard, -32.0, 0.0, yaw)[:, 0] > 0.3).all()


def test_distances_on_flat_ground_follow_from_the_eye_and_the_pitch(hard):
    hard.restart(seed=0)
    values = _looking(hard, -32.0, 0.0, math.pi / 2)
    for ray, value in zip(RAYS, values, strict=True):
        if ray.range_m == 5:
            assert value[0] == pytest.approx(EYE_M / math.sin(math.radians(ray.down_deg)), abs=0.03)
            assert value[1 + CLASSES.index("ground")] == 1.0


def test_a_ray_turned_left_looks_left(hard):
    hard.restart(seed=0)
    half_y = hard.terrain.size_m[1] / 2
    values = _looking(hard, -32.0, half_y - 2.0, 0.0)  # the north wall is on the left hand
    left, right = (values[[ray.name == f"ray_{side}075_d00_r100" for ray in RAYS]][0] for side in "lr")
    assert left[0] == pytest.approx(2.0 / math.sin(math.radians(75)), abs=0.02)
    assert right[0] > 40.0


def test_rays_tell_a_standing_bridge_from_a_broken_one(hard):
    hard.restart(seed=5)
    ahead = [i for i, ray in enumerate(RAYS) if abs(ray.left_deg) == 5 and ray.range_m in (5, 10)]
    river = hard.terrain.rivers[0]
    for slot, standing in zip(river.slots, hard.layout.bridges[0], strict=True):
        seen = _looking(hard, river.rect[0] - 3.0, (slot[1] + slot[3]) / 2, 0.0)[ahead]
        expected = "ground" if standing else "lava"
        assert (seen[:, 1 + CLASSES.index(expected)] == 1.0).all()


@settings(max_examples=40, deadline=None)
@given(query=st.lists(st.booleans(), min_size=96, max_size=96), yaw=st.floats(-3, 3))
def test_asking_for_some_rays_gives_exactly_what_the_full_cast_gives_for_them(query, yaw):
    env = _shared_env()
    asked_M = np.array(query)
    full = _looking(env, -20.0, 3.0, yaw)
    some = env.cast(asked_M).reshape(len(RAYS), RAY_SIZE)
    np.testing.assert_array_equal(some[asked_M], full[asked_M])
    assert (some[~asked_M] == 0.0).all()


def test_only_what_was_asked_for_is_cast(hard, monkeypatch):
    import game.world

    hard.restart(seed=0)
    cast = []
    original = game.world.pybullet.rayTestBatch
    monkeypatch.setattr(
        game.world.pybullet, "rayTestBatch", lambda a, b, **kw: (cast.append(len(a)), original(a, b, **kw))[1]
    )
    query_M = np.zeros(96, dtype=bool)
    assert (hard.cast(query_M) == 0.0).all()
    query_M[[3, 50, 95]] = True
    hard.cast(query_M)
    assert cast == [3]


_ENVS = []


def _shared_env():
    """Hypothesis and function-scoped fixtures do not mix."""
    if not _ENVS:
        from game.env import NavigationEnv

        _ENVS.append(NavigationEnv("hard"))
        _ENVS[0].restart(seed=7)
    return _ENVS[0]
