"""Do frames come through a line that loses, repeats and reorders their messages, each once and with the same actions?

A client plays recorded frames over HTTP through `benchmarks.fault_proxy`, and sends a message again until it is
answered. The same frames are played in process beside it, where nothing gets lost. An action depends on every frame
that was committed before it (the context, the rewards still to come, the noise of the turn), so a frame that was
committed twice or not at all shows in all actions after it.

    python -m benchmarks.chaos --frames 100000 --json
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress

from benchmarks.fault_proxy import FaultProxy, Faults
from benchmarks.recorded import RecordedFrames
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Chaos", "Outcome", "main", "measure", "play"]

_MAX_TRIES = 100  # of one message: 30 % of them fail, so this many never do
T = TypeVar("T")


@dataclass(frozen=True)
class Chaos:
    """Play frames over a bad line."""

    bundle: Path = Path("bundles/hard")
    frames: int = 100_000
    minutes: float = 1e6  # or as long as this
    bots: int = 4  # of each message
    loss: float = 0.2
    duplicates: float = 0.05
    reordered: float = 0.05
    delay_ms: float = 0.0
    seed: int = 0
    json: bool = False  # print one JSON line

    @property
    def faults(self) -> Faults:
        """For the proxy."""
        return Faults(self.loss, self.duplicates, self.reordered, self.delay_ms / 1e3)


@dataclass
class Outcome:
    """What came of the frames."""

    frames: int = 0
    differing: int = 0  # frames whose queries or actions are other than in process
    tries: int = 0  # calls of the client, some of which send a message twice
    seconds: float = 0.0
    befell: dict[str, int] = field(default_factory=dict)  # messages at the proxy

    @property
    def passed(self) -> bool:
        """Whether every frame was committed once."""
        return self.frames > 0 and self.differing == 0

    def answer_to(self, request: Callable[[], T]) -> T:
        """The answer, however often the line fails."""
        for _ in range(_MAX_TRIES):
            self.tries += 1
            try:
                return request()
            except OSError:
                continue
        raise ConnectionError(f"no answer after {_MAX_TRIES} tries")


def measure(config: Chaos, console: Console) -> Outcome:
    """Play against a server of one's own until the frames or the minutes are over."""
    with ServerProcess(config.bundle) as server:
        proxy = FaultProxy(server.addresses()["http"], config.faults, config.seed)
        with proxy.listening() as address, BotClient(address) as client, Progress(console=console) as progress:
            outcome = play(client, config, lambda frames: progress.track(frames, description="frames"))
    outcome.befell = dict(proxy.befell)
    return outcome


def play(client: BotClient, config: Chaos, track: Callable[[range], Iterable[int]]) -> Outcome:
    """Play over this client, beside the same in process. Raises ProtocolError where the server refuses a message."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    recorded = RecordedFrames(bundle.manifest.features, golden, config.bots)
    outcome, clean = Outcome(), Bots(bundle, max_bots=config.bots)
    client.hello()
    seeds = list(range(config.bots))
    bots, handles = client.start(config.bots, seeds=seeds), clean.start(config.bots, seeds=seeds)
    begun = time.monotonic()
    for frame in track(range(config.frames)):
        if time.monotonic() - begun > 60.0 * config.minutes:
            break
        rewards = np.random.default_rng([config.seed, frame]).normal(0.0, 1.0, config.bots)
        free, costly = recorded.free(frame), recorded.costly(frame)
        wanted = clean.request_queries(handles, frame, free, rewards)
        done = clean.submit_features(handles, frame, wanted.query_NM, costly)
        asked = outcome.answer_to(partial(client.query, bots, frame, free, rewards))
        got = outcome.answer_to(partial(client.act, bots, frame, asked.queries, costly))
        same = np.array_equal(asked.queries, wanted.query_NM) and np.array_equal(got.actions, done.action_NA)
        outcome.differing += not same
        outcome.frames += 1
    outcome.seconds = time.monotonic() - begun
    return outcome


def _line(outcome: Outcome) -> dict[str, Any]:
    return {
        "frames": outcome.frames,
        "differing": outcome.differing,
        "tries": outcome.tries,
        "seconds": round(outcome.seconds, 1),
        "befell": outcome.befell,
        "passed": outcome.passed,
    }


def main() -> None:
    """Command line; ends with 1 unless every frame came through once."""
    config = tyro.cli(Chaos, description=__doc__)
    outcome = measure(config, Console(file=sys.stderr))
    line = _line(outcome)
    print(json.dumps(line) if config.json else "\n".join(f"{key:>10}  {value}" for key, value in line.items()))
    sys.exit(not outcome.passed)


if __name__ == "__main__":
    main()
