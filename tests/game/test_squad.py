"""A squad in memory: no server, no sockets, a client that only writes down what it is told."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from game.env import NavigationEnv
from game.rays import RAY_SIZE, RAYS
from game.squad import Bot, Leg, play_leg
from protocol.client import Actions, Queries

DECISIONS = 25
SEEDS = [71, 72, 73, 74, 75]


class Ledger:
    """Asks for random rays, walks at random, and keeps every message."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.started: dict[int, int] = {}
        self.stopped: list[int] = []
        self.turns: list[dict[str, object]] = []

    def start(self, count: int, *, seeds: list[int], budgets_us: list[float] | None) -> np.ndarray:
        self.budgets_us = budgets_us
        handles = [100 + seed for seed in seeds]
        self.started.update(zip(handles, seeds, strict=True))
        assert len(handles) == count
        return np.array(handles)

    def query(self, bots: list[int], frame: int, free: np.ndarray, rewards: list[float]) -> Queries:
        queries_NM = self.rng.random((len(bots), len(RAYS))) < 0.1
        self.turns.append({"frame": frame, "bots": bots, "free": free, "rewards": rewards, "queries": queries_NM})
        charged_N, reasons_N = queries_NM.sum(axis=1) * 2.0, np.zeros(len(bots), dtype=np.uint8)
        return Queries(frame, queries_NM, charged_N, 1.0, reasons_N)

    def act(
        self, bots: list[int], frame: int, acquired: np.ndarray, costly: np.ndarray, acquire_us: float | None
    ) -> Actions:
        assert bots == self.turns[-1]["bots"]
        assert frame == self.turns[-1]["frame"]
        self.turns[-1] |= {"acquired": acquired, "costly": costly, "acquire_us": acquire_us}
        actions_NA = self.rng.uniform([-1, 0, 0], [1, 1, 1], (len(bots), 3)).astype(np.float32)
        self.turns[-1]["actions"] = actions_NA
        return Actions(frame, actions_NA, np.zeros(len(bots), dtype=np.uint8), 2.0)

    def stop(self, bots: list[int]) -> int:
        self.stopped += bots
        return len(bots)


@pytest.fixture(scope="module")
def squad() -> Iterator[list[Bot]]:
    bots = [Bot(NavigationEnv("hard", max_decisions=DECISIONS)) for _ in range(2)]
    yield bots
    for bot in bots:
        bot.env.close()


@pytest.fixture(scope="module")
def played(squad: list[Bot]) -> tuple[Ledger, Leg, list[np.ndarray]]:
    """Five episodes by two bots, and every query that reached the physics."""
    ledger, casts = Ledger(), []
    with pytest.MonkeyPatch.context() as patch:
        for bot in squad:
            original = bot.env.world.cast

            def spy(query_M: np.ndarray, original=original) -> np.ndarray:
                casts.append(query_M.copy())
                return original(query_M)

            patch.setattr(bot.env.world, "cast", spy)
        leg = play_leg(ledger, squad, SEEDS, lambda ended: None)
    return ledger, leg, casts


def test_every_seed_is_played_once_and_every_bot_is_given_back(played):
    ledger, leg, _ = played
    assert sorted(episode.seed for episode in leg.episodes) == SEEDS
    assert sorted(ledger.started.values()) == SEEDS
    assert sorted(ledger.stopped) == sorted(ledger.started)
    assert len(leg.turn_us) == len(ledger.turns)
    assert leg.infer_us == 3.0 * len(ledger.turns)


def test_frames_grow_and_never_more_bots_than_seats(played):
    ledger, _, _ = played
    assert [turn["frame"] for turn in ledger.turns] == list(range(len(ledger.turns)))
    assert {len(turn["bots"]) for turn in ledger.turns} == {1, 2}


def test_only_what_was_asked_for_is_cast_and_sent(played):
    ledger, _, casts = played
    asked = [query_M for turn in ledger.turns for query_M in turn["queries"]]
    everything = [query_M for query_M in casts if query_M.all()]
    assert np.array_equal(np.array(asked), np.array([query_M for query_M in casts if not query_M.all()]))
    assert 0 < len(everything) <= len(asked) / 10
    for turn in ledger.turns:
        assert np.array_equal(turn["acquired"], turn["queries"])
        sent_NM = turn["costly"].reshape(len(turn["bots"]), len(RAYS), RAY_SIZE).any(axis=2)
        assert np.array_equal(sent_NM, turn["queries"])


def test_a_full_cast_is_timed_instead_of_the_turns_own_not_beside_it(played):
    _, leg, _ = played
    for episode in leg.episodes:
        taken_T2 = ~np.isnan(np.column_stack([episode.cast_us, episode.full_cast_us]))
        assert (taken_T2.sum(axis=1) == 1).all()
        assert taken_T2[:, 1].sum() == episode.turns // 10


def test_rewards_are_those_since_the_bots_last_frame(squad, played):
    """The same actions in the same worlds again: each turn is told what the one before it earned."""
    ledger, leg, _ = played
    for episode in leg.episodes:
        rows = [(turn, turn["bots"].index(100 + episode.seed)) for turn in ledger.turns
                if 100 + episode.seed in turn["bots"]]  # fmt: skip
        squad[0].env.restart(seed=episode.seed)
        earned = [squad[0].env.advance(turn["actions"][row])[0] for turn, row in rows]
        assert [turn["rewards"][row] for turn, row in rows] == [0.0, *earned[:-1]]
        assert episode.total == pytest.approx(sum(earned))


def test_an_episode_is_its_seeds_alone(squad, played):
    _, leg, _ = played
    for episode in leg.episodes:
        squad[0].begin(episode.seed, 0)
        assert np.allclose(episode.path_m[0], squad[0].env.layout.start)
        assert episode.layout == squad[0].env.layout
        assert len(episode.path_m) == episode.turns + 1
    squad[0].seed = None


def test_what_the_server_charged_is_kept(played):
    _, leg, _ = played
    for episode in leg.episodes:
        assert np.array_equal(episode.charged_us, 2.0 * episode.queries.sum(axis=1))


def test_what_casting_took_is_told_only_when_it_is_to_count(played, squad):
    ledger, _, _ = played
    assert {turn["acquire_us"] for turn in ledger.turns} == {None}
    measured = Ledger()
    leg = play_leg(measured, squad, SEEDS[:2], lambda ended: None, measure="wall")
    told_us = [turn["acquire_us"] for turn in measured.turns]
    assert min(told_us) > 0.0
    by_cpu = Ledger()
    play_leg(by_cpu, squad, SEEDS[:1], lambda ended: None, measure="cpu", budget_us=12.5)
    assert min(turn["acquire_us"] for turn in by_cpu.turns) > 0.0
    assert (ledger.budgets_us, by_cpu.budgets_us) == (None, [12.5])
    # A turn that timed everything does not keep its own cast's time, so what was kept is the lesser sum.
    assert sum(told_us) > np.nansum(np.concatenate([episode.cast_us for episode in leg.episodes]))
