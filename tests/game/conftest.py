"""Environments are expensive to build and cheap to reset, so each module shares one of each map."""

from collections.abc import Iterator

import pytest

from game.env import NavigationEnv


@pytest.fixture(scope="module")
def hard() -> Iterator[NavigationEnv]:
    env = NavigationEnv("hard")
    yield env
    env.close()


@pytest.fixture(scope="module")
def easy() -> Iterator[NavigationEnv]:
    env = NavigationEnv("easy")
    yield env
    env.close()
