"""A squad: bots that play episodes side by side, each in its own world, all in the same two messages of a frame.

This module knows nothing about how a server is run, or what is shown and drawn. It casts what was asked for and
nothing else; now and then it also times what casting every ray would have taken, and does not look at the values.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from game.env import NavigationEnv
from game.layout import Layout
from protocol.client import BotClient

__all__ = ["Bot", "Episode", "Leg", "Measure", "play_leg"]

Measure = Literal["cpu", "wall"]
"""By what casting is measured: this thread's own time, or the time that the frame waits, others' turns included."""

_FULL_CAST_EVERY = 10
"""Every tenth turn of a bot times a cast of all rays. That turn's own cast comes second, on warm caches, so its time
is not counted: both means are over casts that came first."""


@dataclass(frozen=True)
class Episode:
    """What one episode of T turns leaves. A time that was not taken is NaN."""

    seed: int
    layout: Layout
    total: float  # return
    reached: bool
    died: bool
    path_m: NDArray[np.float64]  # [T + 1, 2]
    queries: NDArray[np.bool_]  # [T, M]
    cast_us: NDArray[np.float64]  # [T], casting what was asked for
    full_cast_us: NDArray[np.float64]  # [T], casting everything
    fallbacks: int  # turns whose action was not the learned one
    charged_us: NDArray[np.float64]  # [T], what the server says that the query costs

    @property
    def turns(self) -> int:
        """T."""
        return len(self.queries)

    @property
    def ending(self) -> str:
        """How it ended, in a word."""
        return "reached" if self.reached else "died" if self.died else "timed out"


@dataclass(frozen=True)
class Leg:
    """Episodes played over one transport. A turn's time is that of its two round trips, without the rays between."""

    episodes: list[Episode]
    turn_us: NDArray[np.float64]  # [frames]
    infer_us: float  # what the server says it spent deciding, summed over frames


@dataclass
class Bot:
    """A seat in the squad: one world, and the episode that is being played in it, if any."""

    env: NavigationEnv
    handle: int = -1
    seed: int | None = None  # None: waiting
    distance_m: float = 0.0
    reward: float = 0.0
    last: Episode | None = None
    queries: list[NDArray[np.bool_]] = field(default_factory=list)
    _total: float = 0.0
    _path_m: list[tuple[float, float]] = field(default_factory=list)
    _cast_us: list[tuple[float, float]] = field(default_factory=list)
    _charged_us: list[float] = field(default_factory=list)
    _fallbacks: int = 0

    def begin(self, seed: int, handle: int) -> None:
        """Draw the episode of a seed."""
        self.seed, self.handle = seed, handle
        self.distance_m = self.env.restart(seed=seed)["distance_m"]
        self.reward = self._total = 0.0
        self.queries, self._cast_us, self._charged_us, self._fallbacks = [], [], [], 0
        self._path_m = [self._here()]

    def cast(self, query_M: NDArray[np.bool_], charged_us: float) -> tuple[NDArray[np.float32], dict[Measure, float]]:
        """Values [D] of what was asked for, and how many µs that took by either clock."""
        full_us = np.nan
        if len(self.queries) % _FULL_CAST_EVERY == _FULL_CAST_EVERY - 1:
            begun = time.perf_counter()
            self.env.cast(np.ones_like(query_M))
            full_us = 1e6 * (time.perf_counter() - begun)
        begun, begun_cpu = time.perf_counter(), time.thread_time()
        costly_D = self.env.cast(query_M)
        cast_us, cpu_us = 1e6 * (time.perf_counter() - begun), 1e6 * (time.thread_time() - begun_cpu)
        self.queries.append(query_M)
        self._cast_us.append((cast_us if np.isnan(full_us) else np.nan, full_us))
        self._charged_us.append(charged_us)
        return costly_D, {"wall": cast_us, "cpu": cpu_us}

    def advance(self, action_A: NDArray[np.float32], reason: int) -> Episode | None:
        """Play one decision; the episode, if that ended it."""
        self.reward, terminated, truncated, info = self.env.advance(action_A)
        self.distance_m = info["distance_m"]
        self._total += self.reward
        self._fallbacks += reason != 0
        self._path_m.append(self._here())
        if not (terminated or truncated) or self.seed is None or self.env.layout is None:
            return None
        cast_us_T2 = np.array(self._cast_us)
        self.last = Episode(
            self.seed, self.env.layout, self._total, info["reached"], info["died"], np.array(self._path_m),
            np.stack(self.queries), cast_us_T2[:, 0], cast_us_T2[:, 1], self._fallbacks, np.array(self._charged_us),
        )  # fmt: skip
        self.seed = None
        return self.last

    def _here(self) -> tuple[float, float]:
        return self.env.world.character.x, self.env.world.character.y


def play_leg(
    client: BotClient,
    squad: Sequence[Bot],
    seeds: Sequence[int],
    on_frame: Callable[[list[Episode]], None],
    *,
    measure: Measure | None = None,
    budget_us: float | None = None,
) -> Leg:
    """Play an episode a seed, as many at once as the squad has bots. The client has said hello.

    With `measure` the server is told what casting took by that clock, and keeps budgets by it; `budget_us` is each
    bot's, instead of the bundle's.
    `on_frame` is told after every frame which episodes have just ended. The server's bot takes the episode's seed, so
    the same seeds give the same episodes. Raises ProtocolError and OSError as the client does.
    """
    waiting, frame = deque(seeds), 0
    episodes: list[Episode] = []
    turn_us: list[float] = []
    infer_us = 0.0
    while live := _seated(client, squad, waiting, budget_us):
        handles = [bot.handle for bot in live]
        free_NF = np.stack([bot.env.observe_free() for bot in live])
        asked_at = time.perf_counter()
        queries = client.query(handles, frame, free_NF, [bot.reward for bot in live])
        told_at = time.perf_counter()
        asked = zip(live, queries.queries, queries.cost_us.tolist(), strict=True)
        costly, taken = zip(*(bot.cast(query_M, charged_us) for bot, query_M, charged_us in asked), strict=True)
        costly_ND = np.stack(costly)
        acquire_us = None if measure is None else sum(took_us[measure] for took_us in taken)
        sent_at = time.perf_counter()
        actions = client.act(handles, frame, queries.queries, costly_ND, acquire_us=acquire_us)
        turn_us.append(1e6 * (time.perf_counter() - sent_at + told_at - asked_at))
        infer_us += queries.infer_us + actions.infer_us
        outcomes = [
            bot.advance(action_A, int(reason))
            for bot, action_A, reason in zip(live, actions.actions, actions.reasons, strict=True)
        ]
        ended = [episode for episode in outcomes if episode is not None]
        if ended:
            client.stop([bot.handle for bot in live if bot.seed is None])
        episodes += ended
        on_frame(ended)
        frame += 1
    return Leg(episodes, np.array(turn_us), infer_us)


def _seated(client: BotClient, squad: Sequence[Bot], waiting: deque[int], budget_us: float | None) -> list[Bot]:
    """Give each idle bot the next episode, and return the bots that play."""
    idle = [bot for bot in squad if bot.seed is None][: len(waiting)]
    if idle:
        seeds = [waiting.popleft() for _ in idle]
        budgets_us = None if budget_us is None else [budget_us] * len(idle)
        handles = client.start(len(idle), seeds=seeds, budgets_us=budgets_us).tolist()
        for bot, seed, handle in zip(idle, seeds, handles, strict=True):
            bot.begin(seed, handle)
    return [bot for bot in squad if bot.seed is not None]
