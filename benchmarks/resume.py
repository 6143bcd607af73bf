"""Does an engine notice that its server was killed? Kills at random instants of a real server, under way.

An engine plays recorded frames without a pause, through a ResumingClient. The server's process gets SIGKILL at a random
instant, over and over, and another is started at the same address. Every query and every action is compared, bit by
bit, with those of the same bots in process, which nobody kills. *Outage* is the longest frame of a kill: the start of a
Python process and the verification of the bundle, the client's last pause, and the replay.

    python -m benchmarks.resume --kills 200 --json
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.recorded import RecordedFrames
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from protocol.resuming import ResumingClient

__all__ = ["Outcome", "Resume", "main", "measure"]

_START_S = 60.0  # within which a killed server's follower has to answer
_UNDER_WAY = 3  # frames of each life, at least
_DELAY_S = 0.05  # at most, from then until the kill


@dataclass(frozen=True)
class Resume:
    """Kill servers."""

    bundle: Path = Path("bundles/hard")
    kills: int = 20
    frames: int = 200  # played after the last kill
    bots: int = 16
    door: Literal["unix", "tcp", "http"] = "unix"
    seed: int = 0  # of the instants
    json: bool = False  # print one JSON line instead of a table


@dataclass(frozen=True)
class Outcome:
    """What came of it. `different_frames` had another query or action than without kills; of `lost_frames`, which were
    acknowledged, the contexts at the end know nothing."""

    door: str
    kills: int
    resumed: int
    frames: int
    different_frames: int
    lost_frames: int
    outage_p50_ms: float
    outage_max_ms: float


class _Server:
    """`python -m server` at one address, as often as it takes."""

    def __init__(self, config: Resume, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free, socket.create_server(("127.0.0.1", 0)) as other:
            http, tcp = free.getsockname()[1], other.getsockname()[1]
        self.url = {
            "unix": f"unix://{folder / 's'}",
            "tcp": f"tcp://127.0.0.1:{tcp}",
            "http": f"http://127.0.0.1:{http}",
        }
        self._command = [
            sys.executable, "-m", "server", "--bundle", str(config.bundle), "--uds", str(folder / "s"),
            "--port", str(http), "--tcp-port", str(tcp), "--max-bots", str(config.bots),
        ]  # fmt: skip
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


class _Killer(threading.Thread):
    """Kills the server whenever the engine is under way again. `frames` is the engine's to count."""

    def __init__(self, server: _Server, kills: int, seed: int) -> None:
        super().__init__(daemon=True)
        self._server, self._left, self._random = server, kills, np.random.default_rng(seed)
        self._played = threading.Condition()
        self._frames = 0
        self.kills = 0

    def count(self) -> None:
        """One more frame was played."""
        with self._played:
            self._frames += 1
            self._played.notify()

    def end(self) -> None:
        """Kill no more, and be gone."""
        with self._played:
            self._left, self._frames = 0, self._frames + _UNDER_WAY
            self._played.notify()
        self.join()

    def run(self) -> None:
        while self.kills < self._left:
            with self._played:
                due = self._frames + _UNDER_WAY
                if not self._played.wait_for(lambda due=due: self._frames >= due, timeout=_START_S) or not self._left:
                    return
            time.sleep(self._random.uniform(0.0, _DELAY_S))
            self._server.kill()
            self.kills += 1
            self._server.start()


def measure(config: Resume, console: Console | None = None) -> Outcome:
    """Play and kill until there were as many kills as asked for, and `frames` frames more."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    recorded = RecordedFrames(bundle.manifest.features, golden, config.bots)
    seeds, different, frame = list(range(config.bots)), 0, 0
    unbroken = Bots(bundle, max_bots=config.bots)
    own = unbroken.start(config.bots, seeds=seeds)
    with _serving(config) as server, ResumingClient(server.url[config.door], limit_s=_START_S) as client:
        _await(client)
        bots, took_ms = client.start(config.bots, seeds=seeds), []
        killer = _Killer(server, config.kills, config.seed)
        killer.start()
        rest = config.frames
        with Progress(console=console or Console(quiet=True)) as progress, ExitStack() as stack:
            stack.callback(killer.end)
            task = progress.add_task("kills", total=config.kills)
            while rest > 0:
                free, rewards = recorded.free(frame), np.full(config.bots, 0.125)
                expected = unbroken.request_queries(own, frame, free, rewards)
                begun = time.perf_counter()
                queries = client.query(bots, frame, free, rewards)
                known = recorded.known(frame, expected.query_NM)
                done = unbroken.submit_features(own, frame, expected.query_NM, known)
                actions = client.act(bots, frame, queries.queries, recorded.known(frame, queries.queries))
                took_ms.append((time.perf_counter() - begun) * 1e3)
                same = np.array_equal(queries.queries, expected.query_NM)
                different += not (same and np.array_equal(actions.actions, done.action_NA))
                frame += 1
                rest -= not killer.is_alive()
                killer.count()
                progress.update(task, completed=killer.kills)
        lost = int((done.turns_N - actions.turns).max()) if actions.turns is not None else frame
        outages = sorted(took_ms)[-max(killer.kills, 1) :]
        return Outcome(
            config.door, killer.kills, client.resumed, frame, different, lost,
            round(float(np.median(outages)), 1), round(max(outages), 1),
        )  # fmt: skip


@contextmanager
def _serving(config: Resume) -> Iterator[_Server]:
    with tempfile.TemporaryDirectory(prefix="bots-") as folder:
        server = _Server(config, Path(folder))
        try:
            yield server
        finally:
            server.kill()


def _await(client: ResumingClient) -> None:
    """Say hello to a server that is still starting."""
    give_up = time.monotonic() + _START_S
    while True:
        try:
            client.hello()
            return
        except OSError:
            if time.monotonic() > give_up:
                raise
            time.sleep(0.02)


def main() -> None:
    """Command line."""
    config = tyro.cli(Resume, description=__doc__)
    outcome = asdict(measure(config, Console(file=sys.stderr)))
    if config.json:
        print(json.dumps(outcome))
        return
    table = Table(title="servers killed at random instants")
    for name in outcome:
        table.add_column(name.replace("_", " "), justify="right")
    table.add_row(*(f"{value:,}" if isinstance(value, int | float) else value for value in outcome.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
