"""What evaluation sees of an environment: the same numbers, whether it pays for each or looks at all of them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from game.env import feature_table
from protocol.features import FeatureTable
from tests.bundles import FEATURES
from tests.training.line import LINE, TIME_LIMIT, TIMED_LINE
from training.environments import Environment, Paying, _Whole, open_environment
from training.feature_map import FeatureMap, MappedFeature

NAVIGATION = "game.env:Navigation-hard-v0"


def test_paying_for_each_ray_changes_nothing_that_is_seen() -> None:
    features = feature_table()
    paid, whole = open_environment(NAVIGATION, features), _Whole(gymnasium.make(NAVIGATION), features.owner)
    assert not isinstance(paid, _Whole)
    random = np.random.default_rng(0)
    for env in (paid, whole):
        env.restart(7)
    for _ in range(60):
        query_M = random.random(feature_table().n_queries) < 0.2
        np.testing.assert_array_equal(paid.free(), whole.free())
        np.testing.assert_array_equal(paid.acquire(query_M), whole.acquire(query_M))
        action_A = np.array([random.uniform(-0.3, 0.3), 1.0, random.random()], dtype=np.float32)
        outcome = paid.advance(action_A)
        assert outcome == whole.advance(action_A)
        if outcome.terminated:
            for env in (paid, whole):
                env.restart(8)


def test_any_environment_hands_on_only_what_was_asked_for() -> None:
    env: Environment = open_environment(LINE, FEATURES)
    env.restart(3)
    nothing, all_of_it = np.zeros(FEATURES.n_queries, dtype=bool), np.ones(FEATURES.n_queries, dtype=bool)
    assert not env.acquire(nothing).any()
    assert (env.acquire(all_of_it) > 0.0).all()
    first = all_of_it & (np.arange(FEATURES.n_queries) == 0)
    np.testing.assert_array_equal(env.acquire(first) > 0.0, FEATURES.owner == 0)


def test_a_time_limit_is_kept() -> None:
    env = open_environment(TIMED_LINE, FEATURES)
    env.restart(3)
    outcomes = [env.advance(np.zeros(3, dtype=np.float32)) for _ in range(TIME_LIMIT)]
    assert [outcome.truncated for outcome in outcomes] == [False, True]


def test_an_environment_that_pays_with_a_time_limit_is_played_through_its_wrapper() -> None:
    if "Limited-navigation-v0" not in gymnasium.registry:
        gymnasium.register("Limited-navigation-v0", "game.env:NavigationEnv", max_episode_steps=TIME_LIMIT)
    env = open_environment("Limited-navigation-v0", feature_table())
    assert isinstance(gymnasium.make("Limited-navigation-v0").unwrapped, Paying)
    env.restart(0)
    for _ in range(TIME_LIMIT):
        outcome = env.advance(np.zeros(3, dtype=np.float32))
    assert outcome.truncated


@pytest.mark.parametrize("name", ["free", "acquire", "restart", "advance"])
def test_both_offer_the_same_calls(name: str) -> None:
    for environment in (NAVIGATION, LINE):
        features = feature_table() if environment == NAVIGATION else FEATURES
        assert callable(getattr(open_environment(environment, features), name))


class Whole(gymnasium.Env):
    """Takes whole numbers only, and shows the last ones."""

    observation_space = gymnasium.spaces.Dict(
        {"last": gymnasium.spaces.Box(-9.0, 9.0, (2,)), "word": gymnasium.spaces.Text(4)}
    )
    action_space = gymnasium.spaces.Box(-3, 3, (2,), np.int64)

    def reset(self, *, seed: int | None = None, options: object = None) -> tuple[dict[str, object], dict[str, object]]:
        return {"last": np.zeros(2), "word": "none"}, {}

    def step(self, action: np.ndarray) -> tuple[dict[str, object], float, bool, bool, dict[str, object]]:
        assert self.action_space.contains(action)
        return {"last": action.astype(np.float64), "word": "some"}, 0.0, False, False, {}


def test_an_environment_of_whole_numbers_gets_whole_numbers() -> None:
    gymnasium.register("Whole-v0", lambda: Whole(), disable_env_checker=True)
    last = FeatureMap((MappedFeature("last", key="last"),))
    env = open_environment("Whole-v0", last.table({"last": 2}), last)
    env.restart(0)
    env.advance(np.array([1.6, -2.2], dtype=np.float32))
    assert env.free().tolist() == [2.0, -2.0]


@pytest.mark.parametrize("name", ["Nope-v0", "no_such_module:Nope-v0", "not an id"])
def test_an_environment_that_cannot_be_made_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"environment {name}: "):
        open_environment(name, FEATURES)


POLE = FeatureMap((MappedFeature("place", (0,)), MappedFeature("speed", (1,), cost_us=1.0)))


@pytest.mark.parametrize(
    ("feature_map", "features", "said"),
    [
        (None, FEATURES, r"environment CartPole-v1 shows .'': 4. numbers, the bundle reads .'free': "),
        (
            FeatureMap((MappedFeature("far", (9,)),)),
            FEATURES,
            "environment CartPole-v1: feature far has number 9, the observation has 0 to 3",
        ),
        (POLE, FEATURES, "environment CartPole-v1 shows other features by the bundle's map"),
    ],
    ids=["no-map", "map-of-another", "another-bundle"],
)
def test_an_environment_of_other_features_is_refused(
    feature_map: FeatureMap | None, features: FeatureTable, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        open_environment("CartPole-v1", features, feature_map)
