"""What does a server do with half, all and twice of what it can carry, when every request has a deadline?

Capacity is measured first, by engines that begin a frame as soon as the last one is done. Then frames come by the
clock, at random instants (seeded, Poisson), each to an engine that is free: a frame is a query and its features, each
with the same deadline. After the worst load comes half of capacity again, and *recovery* is how long after the change
the last answer left that was not a learned one in time.

By the engine's clock an answer is a *miss* that comes later than its deadline; `flagged` is the share of misses that
say so themselves, by a reason, NOT_READY or `late`. The engine's clock counts the way there and back too, which
nobody at the server can flag, so misses by less than `way_us` are not counted.

    python -m benchmarks.overload --json
"""

from __future__ import annotations

import json
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import msgpack
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.cores import set_apart
from benchmarks.recorded import RecordedFrames
from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden, read_golden
from game.launcher import ServerProcess

__all__ = ["Answered", "Overload", "Phase", "main", "measure", "recovery_s", "summary"]

_LENGTH = struct.Struct(">I")
_TIMEOUT_S = 10.0
_WARM_UP_S = 1.0
_FEW = 4  # frames that are out at once while capacity is measured: the server never waits for an engine


@dataclass(frozen=True)
class Overload:
    """Offer a server more than it can carry."""

    bundle: Path = Path("bundles/hard")
    bots: int = 16  # of each engine, named together
    engines: int = 32
    deadline_us: float = 8000.0  # of each request: two make a frame of 16 ms
    way_us: float = 1000.0  # what the way there and back may take
    loads: tuple[float, ...] = (0.5, 1.0, 2.0)  # shares of capacity; the last one is what it recovers from
    seconds: float = 5.0  # of each load
    server: tuple[str, ...] = ()  # more settings of the server, as on its command line
    pin: bool = True  # give the server a core of its own, where there are two
    json: bool = False  # print one JSON line instead of a table


class Answered(NamedTuple):
    """One request: when its answer came and how long it took, and what kind of answer it was."""

    at_s: float
    ms: float
    kind: str  # `learned`, `fallback`, `refused`
    late: bool


class Phase(NamedTuple):
    """A load: how many frames came, how many of them found no engine free, and every request of the others."""

    frames: int
    unsent: int
    answers: list[Answered]
    begun_s: float


class _Engine:
    """One connection, at most one request out."""

    def __init__(self, url: str, bundle: Bundle, golden: Golden, config: Overload) -> None:
        self.socket = _connect(url)
        self._frames = RecordedFrames(bundle.manifest.features, golden, config.bots)
        self._owner, self._deadline_us, self._n_bots = bundle.manifest.features.owner, config.deadline_us, config.bots
        self.answers: list[Answered] = []
        self.is_free, self._asking, self._frame, self._received = True, False, 0, bytearray()
        self._send({"type": "hello", "protocol": 1})
        self._reply()
        self._send({"type": "start_bots", "count": config.bots})
        self._bots = self._reply()["bots"]

    def begin(self) -> None:
        """Send a frame's query."""
        self._frame += 1
        self.is_free, self._asking = False, True
        self._send({**self._head("request_queries"), "free": self._frames.free(self._frame).tobytes()})

    def receive(self) -> None:
        """Read what there is; where that completes a reply, go on with the frame."""
        self._received += self.socket.recv(2**20)
        if len(self._received) < 4 or len(self._received) < 4 + _LENGTH.unpack_from(self._received)[0]:
            return
        reply = msgpack.unpackb(bytes(self._received[4:]))
        self._received.clear()
        self.answers.append(self._answered(reply))
        if reply["type"] != "queries":
            self.is_free = True
            return
        self._asking = False
        bits_NB = np.frombuffer(reply["queries"], dtype=np.uint8).reshape(self._n_bots, -1)
        query_NM = np.unpackbits(bits_NB, axis=1, count=int(self._owner.max()) + 1, bitorder="little").view(np.bool_)
        values = self._frames.costly(self._frame)[query_NM[:, self._owner]].tobytes()
        self._send({**self._head("submit_features"), "acquired": reply["queries"], "values": values})

    def _answered(self, reply: dict[str, Any]) -> Answered:
        now_s = time.monotonic()
        kind = "fallback" if any(reply.get("reasons") or ()) else "learned"
        if reply["type"] == "error":
            if reply["code"] != "NOT_READY":
                raise ConnectionError(f"{reply['code']}: {reply['detail']}")
            kind = "refused"
        return Answered(now_s, 1e3 * (now_s - self._sent_s), kind, bool(reply.get("late")))

    def _head(self, kind: str) -> dict[str, Any]:
        return {"type": kind, "frame": self._frame, "bots": self._bots, "deadline_us": self._deadline_us}

    def _send(self, message: dict[str, Any]) -> None:
        body = msgpack.packb(message)
        self._sent_s = time.monotonic()
        self.socket.sendall(_LENGTH.pack(len(body)) + body)

    def _reply(self) -> dict[str, Any]:
        with self.socket.makefile("rb") as replies:
            (size,) = _LENGTH.unpack(replies.read(4))
            return dict(msgpack.unpackb(replies.read(size)))


def _connect(url: str) -> socket.socket:
    parts = urlsplit(url)
    connected = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connected.settimeout(_TIMEOUT_S)
    connected.connect(parts.path)
    return connected


def _play(engines: list[_Engine], due: Callable[[], float | None], end_s: float) -> tuple[int, int]:
    """Begin a frame whenever one is due (`due` gives its instant, None: as soon as few are out), until the end.

    Returns how many frames were due and how many of them found no engine free.
    """
    by_socket = {engine.socket: engine for engine in engines}
    frames, unsent, at_s = 0, 0, due()
    while (now_s := time.monotonic()) < end_s or any(not engine.is_free for engine in engines):
        if now_s > end_s + _TIMEOUT_S:
            raise TimeoutError("answers are missing")
        while now_s < end_s and (at_s is None or at_s <= now_s):
            free = next((engine for engine in engines if engine.is_free), None)
            if at_s is None and sum(not engine.is_free for engine in engines) >= _FEW:
                break
            frames, unsent = frames + 1, unsent + (free is None)
            if free is not None:
                engines.remove(free)
                engines.append(free)  # in turn
                free.begin()
            at_s = due()
        wait_s = 0.05 if at_s is None else min(0.05, max(0.0, at_s - time.monotonic()))
        for ready in select.select(by_socket, [], [], wait_s)[0]:  # by the microsecond, unlike epoll
            by_socket[ready].receive()
    return frames, unsent


def _phase(engines: list[_Engine], rate_hz: float, seconds: float, seed: int) -> Phase:
    random, begun_s = np.random.default_rng(seed), time.monotonic()
    at_s = [begun_s]

    def due() -> float:
        at_s[0] += random.exponential(1.0 / rate_hz)
        return at_s[0]

    for engine in engines:
        engine.answers = []
    frames, unsent = _play(engines, due, begun_s + seconds)
    return Phase(frames, unsent, sorted(each for engine in engines for each in engine.answers), begun_s)


def summary(phase: Phase, deadline_us: float, way_us: float) -> dict[str, float]:
    """Shares of requests and percentiles of their times in ms."""
    limit_ms = (deadline_us + way_us) / 1e3
    ms = {kind: [each.ms for each in phase.answers if each.kind == kind] for kind in ("learned", "fallback", "refused")}
    missed = [each for each in phase.answers if each.ms > limit_ms]
    flagged = [each for each in missed if each.late or each.kind != "learned"]
    accepted = ms["learned"] + ms["fallback"]
    n_requests = max(1, len(phase.answers))
    rows = {"frames": float(phase.frames), "unsent_pct": 100.0 * phase.unsent / max(1, phase.frames)}
    rows |= {f"{kind}_pct": 100.0 * len(of_kind) / n_requests for kind, of_kind in ms.items()}
    rows["in_time_pct"] = 100.0 * sum(each <= limit_ms for each in accepted) / max(1, len(accepted))
    rows |= {"missed": float(len(missed)), "flagged_pct": 100.0 * len(flagged) / len(missed) if missed else 100.0}
    for name, of_kind in (("accepted", accepted), ("refused", ms["refused"])):
        for percentile in (50.0, 99.0, 99.9):
            value = float(np.percentile(of_kind, percentile)) if of_kind else float("nan")
            rows[f"{name}_p{percentile:g}_ms"] = round(value, 3)
    return rows


def recovery_s(phase: Phase, deadline_us: float, way_us: float) -> float:
    """From the beginning of a bearable load to the last answer in its first half that was not a learned one in time.

    Of the first half only: a machine that others use too stalls now and then at any load. As long as that half is: it
    did not recover within it.
    """
    half_s = phase.begun_s + (phase.answers[-1].at_s - phase.begun_s) / 2 if phase.answers else 0.0
    limit_ms = (deadline_us + way_us) / 1e3
    bad_s = [each.at_s for each in phase.answers if each.kind != "learned" or each.ms > limit_ms]
    return max((at_s - phase.begun_s for at_s in bad_s if at_s < half_s), default=0.0)


def measure(config: Overload) -> dict[str, Any]:
    """Capacity in frames a second, a summary by load, and how long recovery took."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    with ExitStack() as stack:
        most = ("--max-bots", str(config.bots * config.engines), "--max-connections", str(config.engines))
        server = stack.enter_context(ServerProcess(config.bundle, *most, *config.server))
        if config.pin:
            stack.callback(set_apart([server.pid]))
        engines = [_Engine(server.addresses()["unix"], bundle, golden, config) for _ in range(config.engines)]
        for engine in engines:
            stack.callback(engine.socket.close)
        _play(engines, lambda: None, time.monotonic() + _WARM_UP_S)
        begun_s = time.monotonic()
        capacity_hz = _play(engines, lambda: None, begun_s + config.seconds)[0] / (time.monotonic() - begun_s)
        phases = {
            f"{load:g}": _phase(engines, load * capacity_hz, config.seconds, seed)
            for seed, load in enumerate(config.loads)
        }
        after = _phase(engines, 0.5 * capacity_hz, config.seconds, len(config.loads))
    limits = (config.deadline_us, config.way_us)
    return {
        "capacity_hz": round(capacity_hz, 1),
        "loads": {load: summary(phase, *limits) for load, phase in phases.items()},
        "recovery_s": round(recovery_s(after, *limits), 3),
    }


def _table(measured: dict[str, Any]) -> Table:
    title = f"capacity {measured['capacity_hz']:,.0f} frames/s; recovered {measured['recovery_s']:.2f} s after"
    table = Table(title=title)
    table.add_column("")
    for load in measured["loads"]:
        table.add_column(f"{load} x", justify="right")
    for name in next(iter(measured["loads"].values())):
        table.add_row(name, *(f"{rows[name]:,.2f}" for rows in measured["loads"].values()))
    return table


def main() -> None:
    """Command line."""
    config = tyro.cli(Overload, description=__doc__)
    measured = measure(config)
    if config.json:
        print(json.dumps(measured))
    else:
        Console(file=sys.stdout).print(_table(measured))


if __name__ == "__main__":
    main()
