"""Many bots at once: places are refilled, shared budgets hold, and companions change nothing without one."""

from __future__ import annotations

import dataclasses
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bundles import FEATURES, make_bundle
from tests.training.line import LINE, Line, length_of
from training.play import Player, Terms, _passes

SEEDS = list(range(11))


@pytest.fixture(scope="module")
def terms(tmp_path_factory: pytest.TempPathFactory) -> Terms:
    bundle = make_bundle(tmp_path_factory.mktemp("bundles") / "tiny")
    return Terms(
        bundle,
        LINE,
        bots=3,
        budget=1.0,
        frame_budget=None,
        target_cost=None,
        target_return=None,
        with_heat_map=True,
    )


def frames_of(diary: list[int]) -> list[list[int]]:
    """The diary cut into frames: a bot plays once a frame."""
    frames: list[list[int]] = [[]]
    for seed in diary:
        if seed in frames[-1]:
            frames.append([])
        frames[-1].append(seed)
    return frames


def test_a_place_is_taken_again_as_long_as_episodes_are_left(terms: Terms) -> None:
    Line.diary.clear()
    group = Player(terms).play(SEEDS)
    assert {episode.seed: episode.frames for episode in group.episodes} == {seed: length_of(seed) for seed in SEEDS}
    begun: set[int] = set()
    for frame in frames_of(Line.diary):
        if len(begun) < len(SEEDS):
            assert len(frame) == 3
        begun |= set(frame)


def test_without_a_shared_budget_companions_change_nothing(terms: Terms) -> None:
    capped = dataclasses.replace(terms, budget=0.3)
    together = Player(dataclasses.replace(capped, bots=7)).play(SEEDS).episodes
    alone = [Player(dataclasses.replace(capped, bots=1)).play([seed]).episodes[0] for seed in SEEDS]
    by_seed = sorted(together, key=lambda episode: episode.seed)
    for one, other in zip(by_seed, alone, strict=True):
        assert dataclasses.asdict(one) == pytest.approx(dataclasses.asdict(other), rel=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2])
def test_a_shared_budget_holds_for_all_bots_together_and_lets_one_pass_its_part(terms: Terms, share: float) -> None:
    group = Player(dataclasses.replace(terms, frame_budget=share)).play(SEEDS)
    frames = sum(episode.frames for episode in group.episodes)
    assert group.violations == 0
    assert sum(episode.hard_cost * episode.frames for episode in group.episodes) / frames <= share
    assert sum(episode.soft_cost * episode.frames for episode in group.episodes) / frames > share


def test_half_a_budget_that_all_share_is_no_cap_of_one_bot(terms: Terms) -> None:
    shared = dataclasses.replace(terms, frame_budget=0.05)
    capped = dataclasses.replace(terms, budget=0.05)  # less than any of the dear features costs
    most = [max(e.hard_cost for e in Player(case).play(SEEDS).episodes) for case in (shared, capped)]
    assert most[0] > most[1]


def test_a_whole_shared_budget_is_none(terms: Terms) -> None:
    free, whole = (Player(dataclasses.replace(terms, frame_budget=share)).play(SEEDS) for share in (None, 1.0))
    assert free.episodes == whole.episodes


def test_heat_map_counts_every_frame_once_and_costs_what_was_asked_for(terms: Terms) -> None:
    group = Player(terms).play(SEEDS)
    assert group.heat is not None
    heat = group.heat.mean(FEATURES.costs_us, tuple(feature.name for feature in FEATURES.costly))
    lengths = np.array([length_of(seed) for seed in SEEDS])
    np.testing.assert_array_equal(heat.alive_T, [(lengths > t).sum() for t in range(lengths.max())])
    asked = sum(episode.soft_cost * episode.frames for episode in group.episodes)
    assert heat.cost_pct == pytest.approx(100.0 * asked / lengths.sum(), rel=1e-5)


@given(st.lists(st.floats(0.0, 1e6), max_size=30), st.floats(0.0, 1e7))
def test_violations_are_counted_as_real_numbers(costs_us: list[float], budget_us: float) -> None:
    assert _passes(costs_us, budget_us) == (sum(map(Fraction, costs_us)) > Fraction(budget_us))
    exact = float(sum(map(Fraction, costs_us)))
    assert _passes(costs_us, exact) == (sum(map(Fraction, costs_us)) > Fraction(exact))
