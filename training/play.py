"""A group of episodes played through the runtime, many bots at once as one batch.

When an episode ends the next one starts in its place, so that a shared frame budget is shared by as many bots as long
as episodes are left. Without one, no episode depends on its companions. This module knows nothing about processes,
files of results or torch.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.features import CostModel
from training.environments import Environment, open_environment
from training.feature_map import FEATURE_MAP, FeatureMap
from training.heat_map import HeatSums

__all__ = ["Episode", "Group", "Player", "Terms"]

_UNLIMITED_US = 1e9


@dataclass(frozen=True)
class Terms:
    """What is played and under which budgets. Costs are shares of the full cost."""

    bundle: Path
    environment: str
    bots: int  # most bots at once
    budget: float  # hard cap of a bot's query; 1 is none
    frame_budget: float | None  # share of the live bots' full cost that they share each frame; None or 1: none
    target_cost: float | None  # C asked of the network; None: it is not conditioned
    target_return: float | None  # asked for when an episode begins; None: the bundle's
    with_heat_map: bool


@dataclass(frozen=True)
class Episode:
    """One episode's outcome. Costs are shares of the full cost, averaged over the episode's frames."""

    seed: int
    total: float  # return
    frames: int
    soft_cost: float  # what the network asks for on average, before allocation
    hard_cost: float  # what it was allowed to acquire
    violations: int  # frames whose cost passed the bot's own budget
    terminated: bool


@dataclass(frozen=True)
class Group:
    """Episodes that were played together."""

    episodes: list[Episode]
    violations: int  # frames in which all bots together passed the budget that they shared
    acquired_M: NDArray[np.int64]  # how often each feature was acquired
    heat: HeatSums | None


class Player:
    """One process's runtime and environments."""

    def __init__(self, terms: Terms) -> None:
        """Raises BadBundle for a bundle that does not verify."""
        self._terms = terms
        self._bundle = Bundle.load(terms.bundle, replay=False)
        self._costs = CostModel.declared(self._bundle.manifest.features)
        file = terms.bundle / FEATURE_MAP
        self._feature_map = FeatureMap.read(file) if file.exists() else None
        self._budget_us = _UNLIMITED_US if terms.budget == 1.0 else terms.budget * self._costs.full_us
        self._idle: list[Environment] = []

    def play(self, seeds: list[int]) -> Group:
        """Play one episode a seed, in this order as places come free."""
        waiting, live, episodes = deque(seeds), list[_Game](), list[Episode]()
        bots = Bots(self._bundle, max_bots=min(self._terms.bots, len(seeds)))
        heat = HeatSums(self._bundle.manifest.features.n_queries) if self._terms.with_heat_map else None
        acquired_M = np.zeros(self._bundle.manifest.features.n_queries, dtype=np.int64)
        frame = violations = 0
        while waiting or live:
            while waiting and len(live) < bots.max_bots:
                live.append(self._begin(bots, waiting.popleft()))
            violations += self._turn(bots, frame, live, acquired_M, heat)
            for game in live:
                if game.over:
                    bots.stop(game.handle)
                    self._idle.append(game.environment)
                    episodes.append(game.episode())
            live, frame = [game for game in live if not game.over], frame + 1
        return Group(episodes, violations, acquired_M, heat)

    def _begin(self, bots: Bots, seed: int) -> _Game:
        target = self._terms.target_cost
        targets_us = None if target is None else [target * self._costs.full_us]
        asked = self._terms.target_return
        returns = None if asked is None else [asked]
        handle = bots.start(
            1, seeds=[seed], target_returns=returns, budgets_us=[self._budget_us], target_costs_us=targets_us
        )
        if not self._idle:
            features = self._bundle.manifest.features
            self._idle.append(open_environment(self._terms.environment, features, self._feature_map))
        return _Game(seed, handle, self._idle.pop())

    def _turn(
        self, bots: Bots, frame: int, live: list[_Game], acquired_M: NDArray[np.int64], heat: HeatSums | None
    ) -> bool:
        """One frame of every live bot. Returns whether together they passed the frame's budget."""
        handles = np.concatenate([game.handle for game in live])
        free = np.stack([game.environment.free() for game in live])
        rewards = np.array([game.reward for game in live], dtype=np.float32)
        full_us, frame_us = self._costs.full_us, self._frame_budget_us(len(live))
        queries = bots.request_queries(handles, frame, free, rewards, frame_budget_us=frame_us)
        costly = np.stack([game.environment.acquire(q) for game, q in zip(live, queries.query_NM, strict=True)])
        actions = bots.submit_features(handles, frame, queries.query_NM, costly)
        acquired_M += queries.query_NM.sum(axis=0)
        probs_NM = np.nan_to_num(queries.probs_NM)
        if heat is not None:
            heat.add(np.array([game.frames for game in live]), probs_NM)
        soft_N = probs_NM @ self._costs.costs_us / full_us
        spent = [self._costs.costs_us[query_M].tolist() for query_M in queries.query_NM]
        for i, game in enumerate(live):
            game.soft += float(soft_N[i])
            game.hard += math.fsum(spent[i]) / full_us
            game.violations += _passes(spent[i], self._budget_us)
            game.step(actions.action_NA[i])
        return frame_us is not None and _passes([us for costs in spent for us in costs], frame_us)

    def _frame_budget_us(self, n_bots: int) -> float | None:
        share = self._terms.frame_budget
        return None if share is None or share == 1.0 else share * n_bots * self._costs.full_us


def _passes(costs_us: list[float], budget_us: float) -> bool:
    """Whether the costs add up to more than the budget, as real numbers: fsum rounds once, so its sign is exact."""
    return math.fsum([*costs_us, -budget_us]) > 0.0


class _Game:
    """One episode under way."""

    def __init__(self, seed: int, handle: NDArray[np.int64], environment: Environment) -> None:
        self.seed, self.handle, self.environment = seed, handle, environment
        self.reward = self.total = self.soft = self.hard = 0.0
        self.frames = self.violations = 0
        self.over = self.terminated = False
        environment.restart(seed)

    def step(self, action_A: NDArray[np.float32]) -> None:
        self.reward, self.terminated, truncated = self.environment.advance(action_A)
        self.total += self.reward
        self.frames += 1
        self.over = self.terminated or truncated

    def episode(self) -> Episode:
        soft, hard = self.soft / self.frames, self.hard / self.frames
        return Episode(self.seed, self.total, self.frames, soft, hard, self.violations, self.terminated)
