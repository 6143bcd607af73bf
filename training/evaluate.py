"""Return and cost of a *bundle*, played through the runtime: `python -m training.evaluate bundles/hard --episodes 256`.

Plays any gymnasium environment whose observation is {"free": [F], "costly": [D]}. What the bundle did not ask for, it
never sees. This module knows nothing about torch.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium
import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.features import CostModel

__all__ = ["EvaluateConfig", "Evaluation", "evaluate"]

_UNLIMITED_US = 1e9
_CHUNK = 16  # episodes that one worker plays at once, as one batch of bots


@dataclass(frozen=True)
class EvaluateConfig:
    """Which bundle plays what, how often."""

    bundle: tyro.conf.Positional[Path]
    environment: str = ""  # gymnasium id (empty: the one that the bundle names)
    episodes: int = 256
    seed: int = 1_000_000  # first episode's seed; the others follow it, none of them in the shipped traces
    budget: float | None = None  # hard cap of a bot's query as a share of the full cost (None: the bundle's)
    workers: int = os.cpu_count() or 1
    out: Path | None = None  # where evaluation.json goes (None: into the bundle's folder)

    def __post_init__(self) -> None:
        if min(self.episodes, self.workers) < 1:
            raise ValueError(f"episodes is {self.episodes} and workers {self.workers}, expected 1 or more of each")
        if self.budget is not None and not 0.0 <= self.budget <= 1.0:
            raise ValueError(f"budget is {self.budget}, expected a share of the full cost in [0, 1]")


@dataclass(frozen=True)
class Episode:
    """One episode's outcome. Costs are shares of the full cost, averaged over the episode's frames."""

    seed: int
    total: float  # return
    frames: int
    soft_cost: float  # what the network asks for on average, before allocation
    hard_cost: float  # what it was allowed to acquire
    violations: int  # frames whose cost passed the budget
    terminated: bool


@dataclass(frozen=True)
class Evaluation:
    """What a table needs of one bundle."""

    bundle: str
    environment: str
    episodes: int
    seed: int
    budget: float
    return_mean: float
    return_std: float  # over episodes
    return_stderr: float
    soft_cost_pct: float
    hard_cost_pct: float
    violations: int
    frames_mean: float
    terminated_pct: float


class _Player:
    """One worker's runtime: plays a few episodes at once as one batch of bots."""

    def __init__(self, config: EvaluateConfig, environment: str) -> None:
        self._bundle = Bundle.load(config.bundle, replay=False)
        self._costs = CostModel.declared(self._bundle.manifest.features)
        budget = self._bundle.manifest.budget if config.budget is None else config.budget
        self._budget_us = _UNLIMITED_US if budget == 1.0 else budget * self._costs.full_us
        self._environment = environment
        self._environments: list[gymnasium.Env] = []

    def play(self, seeds: list[int]) -> list[Episode]:
        """Play one episode a seed."""
        while len(self._environments) < len(seeds):
            self._environments.append(gymnasium.make(self._environment))
        bots = Bots(self._bundle, max_bots=len(seeds))
        handles = bots.start(len(seeds), seeds=seeds, budgets_us=[self._budget_us] * len(seeds))
        observations = [env.reset(seed=seed)[0] for env, seed in zip(self._environments, seeds, strict=False)]
        games = [
            _Game(i, seed, observation) for i, (seed, observation) in enumerate(zip(seeds, observations, strict=True))
        ]
        live, frame = list(games), 0
        while live:
            self._turn(bots, handles[[game.index for game in live]], frame, live)
            live, frame = [game for game in live if not game.over], frame + 1
        return [game.episode() for game in games]

    def _turn(self, bots: Bots, handles: NDArray[np.int64], frame: int, live: list[_Game]) -> None:
        free = np.stack([game.observation["free"] for game in live])
        costly = np.stack([game.observation["costly"] for game in live])
        rewards = np.array([game.reward for game in live], dtype=np.float32)
        queries = bots.request_queries(handles, frame, free, rewards)
        asked = queries.query_NM[:, self._bundle.manifest.features.owner]
        actions = bots.submit_features(handles, frame, queries.query_NM, np.where(asked, costly, np.float32(0.0)))
        soft = np.nan_to_num(queries.probs_NM) @ self._costs.costs_us / self._costs.full_us
        hard = self._costs.query_cost_us(queries.query_NM)
        for i, game in enumerate(live):
            game.soft += float(soft[i])
            game.hard += float(hard[i]) / self._costs.full_us
            game.violations += int(hard[i] > self._budget_us)
            game.step(self._environments[game.index], actions.action_NA[i])


class _Game:
    """One episode under way."""

    def __init__(self, index: int, seed: int, observation: dict[str, NDArray[np.float32]]) -> None:
        self.index, self.seed, self.observation = index, seed, observation
        self.reward = self.total = self.soft = self.hard = 0.0
        self.frames = self.violations = 0
        self.over = self.terminated = False

    def step(self, env: gymnasium.Env, action: NDArray[np.float32]) -> None:
        self.observation, reward, self.terminated, truncated, _ = env.step(action)
        self.reward = float(reward)
        self.total += self.reward
        self.frames += 1
        self.over = bool(self.terminated or truncated)

    def episode(self) -> Episode:
        soft, hard = self.soft / self.frames, self.hard / self.frames
        return Episode(self.seed, self.total, self.frames, soft, hard, self.violations, bool(self.terminated))


_player: _Player | None = None


def _start_worker(config: EvaluateConfig, environment: str) -> None:
    global _player
    _player = _Player(config, environment)


def _play(seeds: list[int]) -> list[Episode]:
    if _player is None:
        raise RuntimeError("a worker plays only after it was started")
    return _player.play(seeds)


def evaluate(config: EvaluateConfig) -> tuple[Evaluation, list[Episode]]:
    """Play `episodes` episodes in parallel processes. Raises BadBundle for a bundle that does not verify."""
    manifest = Bundle.load(config.bundle).manifest
    environment = config.environment or manifest.provenance.get("environment", "")
    if not environment:
        raise ValueError(f"{config.bundle} names no environment: give one with --environment")
    seeds = list(range(config.seed, config.seed + config.episodes))
    chunks = [seeds[i : i + _CHUNK] for i in range(0, len(seeds), _CHUNK)]
    episodes: list[Episode] = []
    context = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(config.workers, context, _start_worker, (config, environment)) as pool,
        Progress(console=Console(file=sys.stderr)) as progress,
    ):
        task = progress.add_task(f"evaluating {manifest.name}", total=len(seeds))
        for done in as_completed([pool.submit(_play, chunk) for chunk in chunks]):
            episodes += done.result()
            progress.update(task, completed=len(episodes))
    episodes.sort(key=lambda episode: episode.seed)
    returns = np.array([episode.total for episode in episodes])
    return Evaluation(
        bundle=manifest.name,
        environment=environment,
        episodes=len(episodes),
        seed=config.seed,
        budget=manifest.budget if config.budget is None else config.budget,
        return_mean=float(returns.mean()),
        return_std=float(returns.std()),
        return_stderr=float(returns.std() / np.sqrt(len(returns))),
        soft_cost_pct=_frame_mean_pct(episodes, "soft_cost"),
        hard_cost_pct=_frame_mean_pct(episodes, "hard_cost"),
        violations=sum(episode.violations for episode in episodes),
        frames_mean=float(np.mean([episode.frames for episode in episodes])),
        terminated_pct=100.0 * float(np.mean([episode.terminated for episode in episodes])),
    ), episodes


def _frame_mean_pct(episodes: list[Episode], name: str) -> float:
    """Mean over frames, not over episodes: a frame is what an engine pays for."""
    frames = sum(episode.frames for episode in episodes)
    return 100.0 * sum(getattr(episode, name) * episode.frames for episode in episodes) / frames


def main() -> None:
    """Command line: prints one JSON line, and writes it with every episode."""
    config = tyro.cli(EvaluateConfig, description=__doc__)
    evaluation, episodes = evaluate(config)
    out = config.out or config.bundle / "evaluation.json"
    data = {**asdict(evaluation), "returns": [round(episode.total, 3) for episode in episodes]}
    out.write_bytes(msgspec.json.encode(data) + b"\n")
    print(msgspec.json.encode(asdict(evaluation)).decode())


if __name__ == "__main__":
    main()
