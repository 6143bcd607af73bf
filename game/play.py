"""Bots of a trained bundle cross a map and pay for every ray: `python -m game.play`, or `make demo`.

Starts a server in a process of its own (or connects to one), drives a squad of bots through it, and shows what that
saved. This module knows nothing about what a bundle is or how its server works: it speaks the protocol.
"""

from __future__ import annotations

import signal
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn

import tyro
from rich.console import Console

from game.env import ACTION_SPEC, MAX_DECISIONS, NavigationEnv
from game.launcher import ServerFailed, ServerProcess
from game.live import LiveView
from game.picture import draw_picture
from game.squad import Bot, Leg, Measure, play_leg
from game.summary import Summary, full_features_return, print_summary, summarise
from game.terrain import MapError
from protocol.client import BotClient, Welcome
from protocol.errors import ProtocolError
from protocol.features import CostModel
from protocol.transport import open_transport

__all__ = ["Play", "WrongBundle", "play"]


@dataclass(frozen=True)
class Play:
    """Which bundle plays what, and through which server."""

    bundle: Path = Path("bundles/hard")  # what the server serves; with --connect only full_features.json is read of it
    map: str = "hard"  # easy, hard, or a map file of your own
    bots: int = 8  # that play side by side
    episodes: int = 24
    socket_episodes: int = 8  # how many of them, the last ones, go over the socket instead of HTTP
    seed: int = 2_000_000  # of the first episode; the others follow it, none of them in the shipped traces
    max_decisions: int = MAX_DECISIONS  # after which an episode times out; 10 are 1 s
    connect: str | None = None  # http://host:port of a running server, instead of one of our own
    connect_socket: str | None = None  # that server's tcp://host:port or unix:///path; without it all goes over HTTP
    token: str | None = None  # what that server asks for
    measure: Measure | None = None  # keep budgets by what casting takes here by this clock, not by declared costs
    budget_us: float | None = None  # most that a bot may spend in a frame, instead of the bundle's own
    picture: Path = Path("out/demo.png")
    json: bool = False  # end stdout with one line of JSON, and show everything else on stderr

    def __post_init__(self) -> None:
        if min(self.bots, self.episodes, self.max_decisions) < 1:
            raise ValueError("bots, episodes and max_decisions must be at least 1")
        if self.budget_us is not None and not 0.0 <= self.budget_us < float("inf"):
            raise ValueError(f"budget_us is {self.budget_us}, expected 0 or more")
        if not 0 <= self.socket_episodes < self.episodes:
            raise ValueError(f"socket_episodes is {self.socket_episodes}, expected 0 to one less than episodes")
        if self.connect is None and self.connect_socket is not None:
            raise ValueError("connect_socket needs connect")
        for url in (self.connect, self.connect_socket):
            if url is not None:
                open_transport(url, timeout_s=1.0)  # opens nothing yet, and says what is wrong with a URL


class WrongBundle(Exception):
    """The bundle is missing or made for another game; the message says what was expected."""


class _Stopped(BaseException):
    """A signal asks to end."""

    def __init__(self, signal_number: int) -> None:
        self.signal_number = signal_number


def main() -> None:
    """Command line. Exits with 1 if any query cost more than its budget, 2 if nothing could be played."""
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, _stop)
    console = Console()
    try:
        config = tyro.cli(Play, description=__doc__)
        console = Console(stderr=config.json)
        begun = time.monotonic()
        summary = play(config, console)
    except _Stopped as stopped:
        console.print(f"stopped by {signal.Signals(stopped.signal_number).name}; nothing is left running")
        sys.exit(128 + stopped.signal_number)
    except (ServerFailed, WrongBundle, ProtocolError, MapError, ValueError, OSError) as error:
        console.print(f"cannot play: {error}", style="red", markup=False)
        sys.exit(2)
    print_summary(summary, console)
    console.print(f"{time.monotonic() - begun:.1f} s in all")
    if config.json:
        print(summary.json_line())
    sys.exit(1 if summary.budget_violations else 0)


def play(config: Play, console: Console) -> Summary:
    """Play all episodes and draw the picture.

    Raises ServerFailed, WrongBundle, MapError, OSError (the picture) and ProtocolError as the client does.
    """
    config.picture.parent.mkdir(parents=True, exist_ok=True)  # before playing, not after, if it cannot be
    with ExitStack() as stack:
        server = None if config.connect is not None else stack.enter_context(_own_server(config.bundle))
        squad = [  # built while the server loads
            Bot(NavigationEnv(config.map, max_decisions=config.max_decisions))
            for _ in range(min(config.bots, config.episodes))
        ]
        for bot in squad:
            stack.callback(bot.env.close)
        doors = {"http": config.connect, "unix": config.connect_socket} if server is None else server.addresses()
        try:
            welcome, legs = _play_legs(config, console, squad, doors["http"] or "", doors["unix"])
        except OSError as error:
            if server is not None and server.ended:
                raise ServerFailed(f"the server has ended in mid-game:\n{server.tail()}") from error
            raise ServerFailed(f"no answer from {' or '.join(filter(None, doors.values()))}: {error}") from error
        episodes = [episode for leg in legs for episode in leg.episodes]
        costs = CostModel.declared(welcome.features)
        title = f"Bundle {welcome.bundle} on map {squad[0].env.terrain.name}"
        draw_picture(config.picture, squad[0].env.terrain, episodes, costs, welcome.budget_us, title)
    socket = legs[1] if len(legs) > 1 else None
    full_features = full_features_return(config.bundle)
    return summarise(
        legs[0], socket, welcome, config.map, full_features, config.picture, measured=config.measure is not None
    )


def _own_server(bundle: Path) -> ServerProcess:
    if not (bundle / "manifest.json").is_file():
        raise WrongBundle(f"there is no bundle at {bundle} (expected manifest.json in it); give one with --bundle")
    return ServerProcess(bundle)


def _play_legs(
    config: Play, console: Console, squad: list[Bot], http_url: str, socket_url: str | None
) -> tuple[Welcome, list[Leg]]:
    """The first episodes over HTTP, and the last ones over the socket where there is one."""
    over_socket = 0 if socket_url is None else config.socket_episodes
    seeds = range(config.seed, config.seed + config.episodes)
    plan = [(http_url, seeds[: config.episodes - over_socket])]
    if socket_url is not None and over_socket:
        plan.append((socket_url, seeds[config.episodes - over_socket :]))
    legs: list[Leg] = []
    view: LiveView | None = None
    with ExitStack() as stack:
        for url, leg_seeds in plan:
            with BotClient(url) as client:
                welcome = client.hello(token=config.token)
                if config.budget_us is not None:
                    welcome = welcome._replace(budget_us=config.budget_us)
                if view is None:
                    _check_same_game(welcome, squad[0].env)
                    view = stack.enter_context(LiveView(console, squad, welcome, config.episodes))
                view.door = url.partition(":")[0]
                measure, budget_us = config.measure, config.budget_us
                legs.append(play_leg(client, squad, leg_seeds, view.update, measure=measure, budget_us=budget_us))
    return welcome, legs


def _check_same_game(welcome: Welcome, env: NavigationEnv) -> None:
    """A bundle of another game has other features or actions; what its rays cost is its own affair."""
    for what, served, ours in (
        ("feature", welcome.features.features, env.table.features),
        ("action component", welcome.action.components, ACTION_SPEC.components),
    ):
        theirs = [(part.name, getattr(part, "size", 1)) for part in served]
        mine = [(part.name, getattr(part, "size", 1)) for part in ours]
        if theirs != mine:
            odd = sorted({name for name, _ in set(theirs) ^ set(mine)})[:3]
            raise WrongBundle(
                f"bundle {welcome.bundle} is not of this game: {len(theirs)} {what}s, expected {len(mine)}"
                f" (they differ in {', '.join(odd) or 'their order'})"
            )


def _stop(signal_number: int, frame: FrameType | None) -> NoReturn:
    for asking in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asking, signal.SIG_IGN)  # the server is being stopped, which is bounded
    raise _Stopped(signal_number)


if __name__ == "__main__":
    main()
