"""What `benchmarks.peers` times: our turns and others' steps on the same recorded frames, each as one call.

This module knows nothing about rounds or ratios. It needs the extra `peers`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.clocks import CLOCKS, Clock
from benchmarks.cores import set_apart
from benchmarks.peer_policies import D3rlpy, HuggingFace
from benchmarks.policy_server import PolicyClient, policy_server
from benchmarks.recorded import RecordedFrames, Timed, in_process, over
from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden, read_golden
from game.launcher import ServerProcess
from protocol.client import BotClient

__all__ = ["PEERS", "PeerRows", "Step"]

Step = Callable[[], float]
"""Plays the next step of all bots; how many µs it took."""

PEERS: dict[str, Callable[[Any, int], Any]] = {
    "transformers": HuggingFace,
    "transformers, eager": lambda manifest, n_bots: HuggingFace(manifest, n_bots, "eager"),
    "d3rlpy, one by one": D3rlpy,
}
_REWARD = 0.01
_TIMEOUT_S = 60.0


class PeerRows:
    """Servers run as long as `stack` is open, pinned to another core than this process if `pin`.

    By the `cpu` clock there are only the rows that work in this process.
    """

    def __init__(
        self, bundle: Path, int8: Path | None, most_bots: int, stack: ExitStack, *, clock: Clock, pin: bool
    ) -> None:
        self._ours = _load(bundle)
        self._int8 = None if int8 is None else _load(int8)
        self._clock = clock
        self._doors: dict[str, str] = {}
        if clock == "cpu":
            return
        server = stack.enter_context(ServerProcess(bundle, "--tcp-port", "0", "--max-bots", str(4 * most_bots)))
        self._doors = server.addresses()
        self._theirs = stack.enter_context(policy_server("transformers", bundle))
        self._theirs_ours = stack.enter_context(policy_server("bots", bundle))
        if pin:
            stack.callback(set_apart([server.pid, self._theirs.pid, self._theirs_ours.pid]))

    @property
    def warm_up(self) -> int:
        """Steps until every window is full and everything has been made once."""
        return self._ours[0].manifest.context_length + 1

    def steps(self, n_bots: int, clients: ExitStack) -> Iterator[tuple[str, Step]]:
        """Every row's name and step; its clients are closed with `clients`."""
        bundle, golden = self._ours
        manifest = bundle.manifest
        frames = RecordedFrames(manifest.features, golden, n_bots)
        yield "ours", _whole(in_process(bundle, golden, n_bots, self._clock))
        if self._int8 is not None:
            yield "ours, int8", _whole(in_process(*self._int8, n_bots, self._clock))
        for name, make in PEERS.items():
            yield name, _observed(frames, manifest.features.n_queries, make(manifest, n_bots).act, self._clock)
        if self._clock == "wall":
            yield from self._over_sockets(n_bots, frames, clients)

    def _over_sockets(self, n_bots: int, frames: RecordedFrames, clients: ExitStack) -> Iterator[tuple[str, Step]]:
        bundle, golden = self._ours
        for door, url in self._doors.items():
            client = clients.enter_context(BotClient(url, timeout_s=_TIMEOUT_S))
            yield f"ours over {door}", _whole(over(client, bundle, golden, n_bots))
        theirs = clients.enter_context(PolicyClient(self._theirs.port))

        def infer(observation_NO: NDArray[np.float32], reward: float) -> object:
            return theirs.infer({"observation": observation_NO, "reward": reward})

        yield "policy server, transformers", _observed(frames, bundle.manifest.features.n_queries, infer, self._clock)
        ours = clients.enter_context(PolicyClient(self._theirs_ours.port))
        yield "policy server, our bots", _two_calls(frames, ours)


def _load(path: Path) -> tuple[Bundle, Golden]:
    bundle = Bundle.load(path)
    return bundle, read_golden((path / "golden.npz").read_bytes(), bundle.manifest)


def _whole(turn: Callable[[], Timed]) -> Step:
    return lambda: turn()[0]


def _observed(
    frames: RecordedFrames, n_queries: int, act: Callable[[NDArray[np.float32], float], object], clock: Clock
) -> Step:
    """A step that is told everything at once: free numbers, all that was recorded, and that all was acquired."""
    frame, now_ns = 0, CLOCKS[clock]

    def step() -> float:
        nonlocal frame
        free_NF, costly_ND = frames.free(frame), frames.costly(frame)
        query_NM = np.ones((len(free_NF), n_queries), dtype=np.float32)
        observation_NO = np.concatenate([free_NF, costly_ND, query_NM], axis=1)
        frame += 1
        begun = now_ns()
        act(observation_NO, _REWARD)
        return (now_ns() - begun) / 1e3

    return step


def _two_calls(frames: RecordedFrames, client: PolicyClient) -> Step:
    """Our turn through the policy server: one call for what to acquire, one for the actions."""
    frame = 0

    def step() -> float:
        nonlocal frame
        free_NF = frames.free(frame)
        begun = time.perf_counter_ns()
        query_NM = client.infer({"frame": frame, "free": free_NF})["query"]
        told = time.perf_counter_ns()
        known_ND = frames.known(frame, query_NM)
        sent = time.perf_counter_ns()
        client.infer({"frame": frame, "query": query_NM, "costly": known_ND})
        frame += 1
        return (time.perf_counter_ns() - sent + told - begun) / 1e3

    return step
