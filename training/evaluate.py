"""Return and cost of a *bundle*, played through the runtime: `python -m training.evaluate bundles/hard --episodes 256`.

Plays any gymnasium environment whose observation is {"free": [F], "costly": [D]}. What the bundle did not ask for, it
never sees. This module knows nothing about torch.
"""

from __future__ import annotations

import math
import os
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
import tyro

from bot_runtime.bundle import Bundle
from bot_runtime.manifest import Manifest
from protocol.messages import MAX_RETURN
from training.command import command, terminable
from training.feature_map import FEATURE_MAP, FeatureMap
from training.heat_map import HeatSums
from training.play import Episode, Group, Terms
from training.players import play_groups

__all__ = ["Episode", "EvaluateConfig", "Evaluation", "evaluate", "write_evaluation"]

_EPISODES_A_BOT = 4  # in a group: enough that most frames have all places taken


@dataclass(frozen=True)
class EvaluateConfig:
    """Which bundle plays what, how often, under which budgets. Budgets are shares of the full cost."""

    bundle: tyro.conf.Positional[Path]
    environment: str = ""  # gymnasium id (empty: the one that the bundle names)
    episodes: int = 256
    seed: int = 1_000_000  # first episode's seed; the others follow it, none of them in the shipped traces
    target_cost: float | None = None  # C asked of a budget-conditioned bundle (None: the bundle's)
    target_return: float | None = None  # return asked for at the start of an episode (None: the bundle's)
    budget: float | None = None  # hard cap of a bot's query; 1 is none (None: the bundle's, or 1 with a frame budget)
    frame_budget: float | None = None  # hard cap that all bots alive in a frame share, of their full cost (None: none)
    bots: int = 32  # most bots at once, as one batch
    workers: int = os.cpu_count() or 1
    out: Path | None = None  # where evaluation.json goes (None: into the bundle's folder, unless it has one)
    heat_map: Path | None = None  # where the acquisition heat map goes (None: nowhere)

    def __post_init__(self) -> None:
        for name in ("episodes", "workers", "bots"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 1 or more")
        for name in ("target_cost", "budget", "frame_budget"):
            share = getattr(self, name)
            if share is not None and not 0.0 <= share <= 1.0:
                raise ValueError(f"{name} is {share}, expected a share of the full cost in [0, 1]")
        if self.target_return is not None and not abs(self.target_return) <= MAX_RETURN:
            raise ValueError(f"target_return is {self.target_return}, expected at most {MAX_RETURN:g} either way")


@dataclass(frozen=True)
class Evaluation:
    """What a table needs of one bundle."""

    bundle: str
    environment: str
    episodes: int
    seed: int
    budget: float  # hard cap of one bot; 1 is none
    return_mean: float
    return_std: float  # over episodes
    return_stderr: float | None  # of the mean (None: one episode tells none)
    soft_cost_pct: float
    hard_cost_pct: float
    violations: int  # frames in which a bot passed its own budget, or all together the one that they share
    frames_mean: float
    terminated_pct: float
    method: str
    acquisition: str  # learned, random, all or none
    dataset: str  # folder that it was trained on, such as hard-expert-v0
    trained_budget: float | None  # C that it was trained for (None: one network for every budget)
    train_seed: int | None
    target_cost: float | None  # C asked of the network (None: not conditioned)
    target_return: float
    frame_budget: float | None  # shared by all bots alive in a frame (None: none)
    bots: int
    normalised_mean: float | None  # return_mean where the bundle's reference returns are 0 and 100
    acquired_pct: dict[str, float]  # of the features of each group that its feature map names, mean over frames


def evaluate(config: EvaluateConfig) -> tuple[Evaluation, list[Episode]]:
    """Play `episodes` episodes in parallel processes, and write the heat map if one is asked for.

    The outcome depends neither on `workers` nor, without a frame budget, on `bots`. Raises BadBundle for a bundle that
    does not verify, ValueError for a target cost that it cannot be asked for or an environment of other features.
    """
    bundle = Bundle.load(config.bundle)
    if (config.bundle / FEATURE_MAP).exists():
        FeatureMap.read(config.bundle / FEATURE_MAP)  # a process that plays could not say what is wrong with it
    terms = _terms(config, bundle.manifest)
    groups = play_groups(terms, _groups(config), config.workers, bundle.name)
    episodes = sorted((episode for group in groups for episode in group.episodes), key=lambda episode: episode.seed)
    if config.heat_map is not None:
        _write_heat_map(config.heat_map, groups, bundle.manifest)
    return _summary(config, terms, bundle.manifest, episodes, groups), episodes


def write_evaluation(path: Path, evaluation: Evaluation, episodes: list[Episode]) -> None:
    """Write one line of JSON: the evaluation, and the return of each episode."""
    data = {**asdict(evaluation), "returns": [round(episode.total, 3) for episode in episodes]}
    path.write_bytes(msgspec.json.encode(data) + b"\n")


def _terms(config: EvaluateConfig, manifest: Manifest) -> Terms:
    environment = config.environment or manifest.provenance.get("environment", "")
    if not environment:
        raise ValueError(f"{config.bundle} names no environment: give one with --environment")
    target_cost = config.target_cost
    if manifest.target_cost is None and target_cost is not None:
        raise ValueError(f"target_cost is {target_cost}, expected none: {manifest.name} is not conditioned on a budget")
    if target_cost is None:
        target_cost = manifest.target_cost
    budget = config.budget
    if budget is None:
        budget = manifest.budget if config.frame_budget is None else 1.0
    return Terms(
        bundle=config.bundle,
        environment=environment,
        bots=config.bots,
        budget=budget,
        frame_budget=config.frame_budget,
        target_cost=target_cost,
        target_return=config.target_return,
        with_heat_map=config.heat_map is not None,
    )


def _groups(config: EvaluateConfig) -> list[list[int]]:
    """Seeds that play together. Who plays with whom follows from `episodes` and `bots` alone."""
    seeds = np.arange(config.seed, config.seed + config.episodes)
    n_groups = math.ceil(config.episodes / (_EPISODES_A_BOT * config.bots))
    return [part.tolist() for part in np.array_split(seeds, n_groups)]


def _summary(
    config: EvaluateConfig, terms: Terms, manifest: Manifest, episodes: list[Episode], groups: list[Group]
) -> Evaluation:
    returns = np.array([episode.total for episode in episodes])
    origin = manifest.provenance
    trained_budget = origin.get("trained_budget", "conditioned")
    return Evaluation(
        bundle=manifest.name,
        environment=terms.environment,
        episodes=len(episodes),
        seed=config.seed,
        budget=terms.budget,
        return_mean=float(returns.mean()),
        return_std=float(returns.std()),
        return_stderr=float(returns.std(ddof=1) / np.sqrt(len(returns))) if len(returns) > 1 else None,
        soft_cost_pct=_frame_mean_pct(episodes, "soft_cost"),
        hard_cost_pct=_frame_mean_pct(episodes, "hard_cost"),
        violations=sum(played.violations for played in (*groups, *episodes)),
        frames_mean=float(np.mean([episode.frames for episode in episodes])),
        terminated_pct=100.0 * float(np.mean([episode.terminated for episode in episodes])),
        method=manifest.method,
        acquisition=origin.get("acquisition", ""),
        dataset=origin.get("dataset", ""),
        trained_budget=None if trained_budget == "conditioned" else float(trained_budget),
        train_seed=int(origin["seed"]) if "seed" in origin else None,
        target_cost=terms.target_cost,
        target_return=manifest.target_return if terms.target_return is None else terms.target_return,
        frame_budget=terms.frame_budget,
        bots=terms.bots,
        normalised_mean=_normalised(float(returns.mean()), origin.get("reference_returns")),
        acquired_pct=_acquired_pct(config.bundle / FEATURE_MAP, episodes, groups),
    )


def _normalised(value: float, references: str | None) -> float | None:
    """D4RL's score of a return: 0 and 100 at the two references, `low high`."""
    if references is None:
        return None
    low, high = map(float, references.split())
    return 100.0 * (value - low) / (high - low)


def _acquired_pct(file: Path, episodes: list[Episode], groups: list[Group]) -> dict[str, float]:
    """Of each named group of features, how many were acquired in a frame, %. A map without groups has none."""
    if not file.exists():
        return {}
    frames = sum(episode.frames for episode in episodes)
    rates_M = 100.0 * sum(group.acquired_M for group in groups) / frames
    kinds = np.array(FeatureMap.read(file).groups)
    return {str(kind): float(rates_M[kinds == kind].mean()) for kind in dict.fromkeys(kinds) if kind}


def _frame_mean_pct(episodes: list[Episode], name: str) -> float:
    """Mean over frames, not over episodes: a frame is what an engine pays for."""
    frames = sum(episode.frames for episode in episodes)
    total: float = sum(getattr(episode, name) * episode.frames for episode in episodes)
    return 100.0 * total / frames


def _write_heat_map(path: Path, groups: list[Group], manifest: Manifest) -> None:
    total = HeatSums(manifest.features.n_queries)
    for group in groups:
        if group.heat is not None:
            total.merge(group.heat)
    features = manifest.features
    total.mean(features.costs_us, tuple(feature.name for feature in features.costly)).write(path)


def main(arguments: list[str] | None = None) -> None:
    """Command line: prints one JSON line, and writes it with every episode; no record of before is replaced unasked."""
    with command(), terminable():
        config = tyro.cli(EvaluateConfig, args=arguments, description=__doc__)
        for path in (config.out, config.heat_map):
            if path is not None and (path.is_dir() or not path.parent.is_dir()):
                raise ValueError(f"{path} is a folder or in none, expected a file's place")
        evaluation, episodes = evaluate(config)
        print(msgspec.json.encode(asdict(evaluation)).decode(), flush=True)
        record = config.bundle / "evaluation.json"
        if config.out is not None or not record.exists():
            write_evaluation(config.out or record, evaluation, episodes)
        else:
            print(f"{record} stays as it is: --out writes elsewhere", file=sys.stderr)


if __name__ == "__main__":
    main()
