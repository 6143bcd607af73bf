"""Versions exchanged under load: `python -m benchmarks.swaps --swaps 1000`.

A server of its own serves a store of a few versions of one bundle, of which all but the first have shaken weights, so
that what they do tells which it was. Engines play episodes as fast as they can, some over one connection, some saying
hello before each, some on a version by name, while versions are activated and rolled back. Every query and action is
compared with what the version that `bots_started` named does in process: a frame that fails and an episode of which a
part is another version's are counted, and must not be there.

Frames are timed before the exchanges and during them; the two are compared within one run.
"""

from __future__ import annotations

import http.client
import json
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track

from benchmarks.recorded import RecordedFrames
from benchmarks.variants import write_variant
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["Engine", "Expected", "Swaps", "main", "measure"]

_TOKEN = "the-operators-token"
_TOLERANCE = 1e-5  # of actions; batches of other sizes round otherwise
_MIN_TELLING = 0.9
Turn = tuple[np.ndarray, np.ndarray]  # queries [N, M], actions [N, A]
_HABITS = ("keeps its connection", "says hello again", "names the version")


@dataclass(frozen=True)
class Swaps:
    """Exchange versions under load."""

    bundle: Path = Path("bundles/hard")
    versions: int = 3
    swaps: int = 1000
    engines: int = 3
    bots: int = 4  # of each engine
    frames: int = 20  # of an episode
    quiet_s: float = 5.0  # of playing before the first exchange
    json: bool = False  # print one JSON line


class Expected:
    """What each version's bots do on the recorded frames, in process."""

    def __init__(self, folder: Path, config: Swaps) -> None:
        self.bots, self.frames = config.bots, config.frames
        self.turns: dict[int, list[Turn]] = {}
        for version in range(1, config.versions + 1):
            bundle = Bundle.load(folder / str(version))
            golden = read_golden((folder / str(version) / "golden.npz").read_bytes(), bundle.manifest)
            self.recorded = RecordedFrames(bundle.manifest.features, golden, config.bots)
            bots = Bots(bundle, max_bots=config.bots)
            handles, turns = bots.start(config.bots, seeds=range(config.bots)), []
            for frame in range(config.frames):
                query_NM = bots.request_queries(handles, frame, self.recorded.free(frame)).query_NM
                costly = self.recorded.costly(frame)
                turns.append((query_NM, bots.submit_features(handles, frame, query_NM, costly).action_NA))
            self.turns[version] = turns

    def is_of(self, version: int, turns: Sequence[Turn]) -> bool:
        """Whether these are the turns of this version."""
        return all(map(_same, turns, self.turns[version]))

    @property
    def telling(self) -> float:
        """The share of frames by which every version can be told from the first."""
        first, *others = self.turns.values()
        return float(np.mean([all(not _same(turn, turns[i]) for turns in others) for i, turn in enumerate(first)]))


def _same(one: Turn, other: Turn) -> bool:
    return np.array_equal(one[0], other[0]) and np.allclose(one[1], other[1], atol=_TOLERANCE, rtol=0.0)


@dataclass
class Engine:
    """Plays episodes in a thread until told to stop, and keeps count."""

    address: str
    name: str
    habit: str
    expected: Expected
    stop: threading.Event
    frame_ms: list[tuple[float, float]] = field(default_factory=list)  # when it began, how long it took
    episodes: int = 0
    moved: int = 0  # episodes on another version than that of the welcome
    mixed: int = 0
    failures: list[str] = field(default_factory=list)

    def play(self) -> None:
        """The thread's work."""
        while not self.stop.is_set():
            try:
                self._connected()
            except Exception as error:  # whatever it is, a frame was lost
                self.failures.append(repr(error))
                self.stop.wait(0.05)

    def _connected(self) -> None:
        with BotClient(self.address, timeout_s=30.0) as scout, BotClient(self.address, timeout_s=30.0) as client:
            named = self.name
            if self.habit == "names the version":  # which the scout's connection holds in memory
                named = f"{named}@{scout.hello(bundle=named).bundle_version}"
            version = client.hello(bundle=named).bundle_version
            while not self.stop.is_set():
                self._episode(client, version)
                if self.habit != "keeps its connection":
                    return

    def _episode(self, client: BotClient, greeted: int | None) -> None:
        expected, turns = self.expected, []
        handles = client.start(expected.bots, seeds=range(expected.bots))
        version = client.welcome.bundle_version
        for frame in range(expected.frames):
            begun = time.monotonic()
            query_NM = client.query(handles, frame, expected.recorded.free(frame)).queries
            turns.append((query_NM, client.act(handles, frame, query_NM, expected.recorded.costly(frame)).actions))
            self.frame_ms.append((begun, (time.monotonic() - begun) * 1e3))
        client.stop(handles)
        self.episodes += 1
        self.moved += version != greeted
        self.mixed += version is None or not expected.is_of(version, turns)


def measure(config: Swaps, console: Console) -> dict[str, Any]:
    """What came of it: counts, and quantiles of times in ms."""
    with tempfile.TemporaryDirectory(prefix="swaps-") as scratch:
        name = _fill(Path(scratch), config)
        expected = Expected(Path(scratch) / name, config)
        if expected.telling < _MIN_TELLING:
            raise ValueError("the versions do nearly the same: nobody could tell a mixed episode")
        (Path(scratch) / "token").write_text(_TOKEN)
        arguments = ("--store", scratch, "--admin-token-file", str(Path(scratch) / "token"))
        with ServerProcess(None, *arguments) as server:
            addresses, stop = server.addresses(), threading.Event()
            habits = [habit for habit, _ in zip(cycle(_HABITS), range(config.engines), strict=False)]
            engines = [Engine(addresses["unix"], name, habit, expected, stop) for habit in habits]
            threads = [threading.Thread(target=engine.play) for engine in engines]
            for thread in threads:
                thread.start()
            try:
                time.sleep(config.quiet_s)
                begun = time.monotonic()
                swap_ms, waited = _exchange(addresses["http"], name, config, console)
            finally:
                stop.set()
                for thread in threads:
                    thread.join()
    return _summary(engines, begun, swap_ms, waited)


def _fill(store: Path, config: Swaps) -> str:
    """Write the versions; what they are called."""
    name = str(msgspec.json.decode((config.bundle / "manifest.json").read_bytes())["name"])
    (store / name).mkdir()
    for version in range(1, config.versions + 1):
        write_variant(config.bundle, store / name / str(version), name=name, seed=version - 1)
    return name


def _exchange(address: str, name: str, config: Swaps, console: Console) -> tuple[list[float], int]:
    """Activate each version in turn, and roll back every third time; ms of each, and how often it had to wait."""
    swap_ms: list[float] = []
    waited, versions = 0, cycle(range(1, config.versions + 1))
    for number in track(range(config.swaps), "exchanges", console=console):
        rolls_back = number % 3 == 2
        path, body = ("rollback", {}) if rolls_back else ("activate", {"version": next(versions)})
        begun = time.monotonic()
        while (status := _post(address, f"/v1/bundles/{name}/{path}", body)) == http.client.SERVICE_UNAVAILABLE:
            waited += 1
            time.sleep(0.02)
        if status != http.client.OK:
            raise ConnectionError(f"{path} was answered with {status}")
        swap_ms.append((time.monotonic() - begun) * 1e3)
    return swap_ms, waited


def _post(address: str, path: str, body: dict[str, Any]) -> int:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=180)
    try:
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {_TOKEN}"}
        connection.request("POST", path, json.dumps(body), headers)
        with connection.getresponse() as response:
            response.read()
            return response.status
    finally:
        connection.close()


def _summary(engines: list[Engine], begun: float, swap_ms: list[float], waited: int) -> dict[str, Any]:
    frames = [frame for engine in engines for frame in engine.frame_ms]
    quiet, busy = ([ms for at, ms in frames if (at >= begun) == later] for later in (False, True))
    failures = [failure for engine in engines for failure in engine.failures]
    return {
        "swaps": len(swap_ms),
        "swaps_that_waited": waited,
        "frames": len(frames),
        "failed_frames": len(failures),
        "episodes": sum(engine.episodes for engine in engines),
        "mixed_episodes": sum(engine.mixed for engine in engines),
        "moved_without_hello": sum(engine.moved for engine in engines),
        "swap_ms": _quantiles(swap_ms),
        "frame_ms_before": _quantiles(quiet),
        "frame_ms_during": _quantiles(busy),
        "failures": failures[:3],
    }


def _quantiles(times_ms: list[float]) -> dict[str, float]:
    if not times_ms:
        return {}
    p50, p99, most = np.percentile(times_ms, [50, 99, 100])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "max": round(float(most), 2)}


def main() -> None:
    """Command line; ends with 1 unless no frame failed and no episode was mixed."""
    config = tyro.cli(Swaps, description=__doc__)
    found = measure(config, Console(file=sys.stderr))
    print(json.dumps(found) if config.json else "\n".join(f"{key:>20}  {value}" for key, value in found.items()))
    sys.exit(found["failed_frames"] > 0 or found["mixed_episodes"] > 0 or found["episodes"] == 0)


if __name__ == "__main__":
    main()
