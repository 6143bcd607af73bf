"""Record scripted players into a Minari dataset: `python -m game.collect --map hard --player expert --episodes 2500`.

Episodes are played in parallel and written in shards; an interrupted run goes on where it stopped when it is started
again with the same arguments. The data depends on the seed and not on the number of workers.

This module knows nothing about training.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import multiprocessing
import os
import shutil
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import gymnasium
import msgspec
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from game.env import ACTION_SPEC, NavigationEnv
from game.players import Kicks, Player
from game.recording import Episode, Summary, merge_shards, summarise, write_shard
from game.skills import EXPERT, GROUNDED, INTERMEDIATE, NEARSIGHTED, Skill
from game.terrain import MapError

__all__ = ["Collect", "collect", "dataset_id", "play_episode"]

_SHARD_EPISODES = 25
_SKILLS = {skill.name: skill for skill in (EXPERT, NEARSIGHTED, GROUNDED, INTERMEDIATE)}


@dataclass(frozen=True)
class Collect:
    """What to record, and where to."""

    map: str = "hard"  # easy, hard, or a map file of your own
    player: Literal["expert", "nearsighted", "grounded", "intermediate"] = "expert"
    episodes: int = 2500
    seed: int = 0  # episode i is played with seed * 1,000,000 + i
    workers: int = os.cpu_count() or 1  # processes
    out: Path = Path("data/navigation")  # MINARI_DATASETS_PATH of the dataset
    kick_chance: float = 0.07  # per decision; a kick disturbs what is executed, not what is recorded
    sight_m: float | None = None  # how far the player recognises bridges and pools (None: as its skill says)

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.workers < 1:
            raise ValueError(f"episodes is {self.episodes} and workers {self.workers}, expected 1 or more of both")
        if self.sight_m is not None and not self.sight_m > 0.0:
            raise ValueError(f"sight_m is {self.sight_m}, expected above 0 m")

    @property
    def skill(self) -> Skill:
        """How well the player sees and moves."""
        skill = _SKILLS[self.player]
        return skill if self.sight_m is None else replace(skill, sight_m=self.sight_m)


def main() -> None:
    """Command line."""
    config = tyro.cli(Collect, description=__doc__)
    console = Console()
    begun = time.perf_counter()
    try:
        folder, summary = collect(config, console)
    except (MapError, OSError) as error:
        sys.exit(f"error: {error}")
    wall_s = time.perf_counter() - begun
    megabytes = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6
    returns, lengths = np.array(summary.returns), np.array(summary.lengths)
    console.print(
        f"{dataset_id(config)}: {len(returns)} episodes, mean return {returns.mean():.1f}, mean length "
        f"{lengths.mean():.1f}, {summary.deaths} deaths, {lengths.sum() / wall_s:.0f} steps/s in {wall_s:.0f} s, "
        f"{megabytes:.0f} MB in {folder}"
    )


def dataset_id(config: Collect) -> str:
    """`navigation/hard-expert-v0`."""
    return f"navigation/{Path(config.map).stem}-{config.player}-v0"


def collect(config: Collect, console: Console) -> tuple[Path, Summary]:
    """Play and record all episodes; returns the dataset's folder and what is in it."""
    shard_folder = config.out / dataset_id(config) / f"shards-{_fingerprint(config)}"
    shard_folder.mkdir(parents=True, exist_ok=True)
    firsts = range(0, config.episodes, _SHARD_EPISODES)
    shards = [shard_folder / f"shard_{first:06d}.hdf5" for first in firsts]
    _play_missing(config, list(zip(firsts, shards, strict=True)), console)
    summaries = [summarise(shard) for shard in shards]
    env = gymnasium.make("game.env:Navigation-v0", map=config.map)
    folder = merge_shards(
        config.out,
        dataset_id(config),
        shards,
        env.spec,
        (env.observation_space, env.action_space),
        _metadata(config, env),
    )
    env.close()
    shutil.rmtree(shard_folder)
    return folder, Summary(
        sum((summary.returns for summary in summaries), ()),
        sum((summary.lengths for summary in summaries), ()),
        sum(summary.deaths for summary in summaries),
    )


def play_episode(env: NavigationEnv, player: Player, seed: int, kick_chance: float) -> Episode:
    """One episode of a player; the layout, the player's mood and the kicks all follow from the seed."""
    observation, _ = env.reset(seed=seed)
    rng = np.random.default_rng([seed, 1])
    player.start(env.layout, rng)
    kicks = Kicks(rng, kick_chance)
    observations, actions, rewards = [observation], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        intended = player.act(env.world.character)
        observation, reward, terminated, truncated, _ = env.step(kicks.executed(intended, env))
        observations.append(observation)
        actions.append(intended)
        rewards.append(reward)
    last = np.arange(len(rewards)) == len(rewards) - 1
    return Episode(
        seed,
        np.stack([observation["free"] for observation in observations]),
        np.stack([observation["costly"] for observation in observations]),
        np.stack(actions),
        np.array(rewards, dtype=np.float32),
        last & terminated,
        last & truncated,
    )


def _play_missing(config: Collect, shards: list[tuple[int, Path]], console: Console) -> None:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        Progress(*columns, console=console) as progress,
        ProcessPoolExecutor(
            config.workers, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_parent
        ) as pool,
    ):
        task = progress.add_task(dataset_id(config), total=config.episodes)
        jobs = {}
        for first, path in shards:
            count = min(_SHARD_EPISODES, config.episodes - first)
            if path.exists():
                progress.advance(task, count)
            else:
                jobs[pool.submit(_play_shard, config, first, count, path)] = count
        try:
            for job in as_completed(jobs):
                job.result()
                progress.advance(task, jobs[job])
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """A worker whose parent was killed would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _play_shard(config: Collect, first: int, count: int, path: Path) -> None:
    env = NavigationEnv(config.map)
    player = Player(config.skill, env.terrain)
    seeds = range(config.seed * 1_000_000 + first, config.seed * 1_000_000 + first + count)
    write_shard(path, (play_episode(env, player, seed, config.kick_chance) for seed in seeds))
    env.close()


def _fingerprint(config: Collect) -> str:
    """Shards may only be joined with shards of the same arguments, map and game."""
    what = {key: str(value) for key, value in asdict(config).items() if key not in ("workers", "out")}
    env = NavigationEnv(config.map)
    what["terrain"] = msgspec.json.encode(env.terrain).decode()
    what["skill"] = str(config.skill)
    env.close()
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]


def _metadata(config: Collect, env: gymnasium.Env) -> dict[str, str]:
    """What training needs to know of the game (`features`, `action`), and where the data come from."""
    inner = env.unwrapped
    versions = {name: importlib.metadata.version(name) for name in ("pybullet", "numpy", "gymnasium", "minari")}
    return {
        "features": msgspec.json.encode(inner.table).decode(),
        "action": msgspec.json.encode(ACTION_SPEC).decode(),
        "algorithm_name": f"scripted {config.player}",
        "collect": json.dumps({key: str(value) for key, value in asdict(config).items() if key != "out"}),
        "terrain": msgspec.json.encode(inner.terrain).decode(),
        "skill": json.dumps(asdict(config.skill)),
        "versions": json.dumps(versions),
        "minari_version": versions["minari"],
    }


if __name__ == "__main__":
    main()
