"""A policy behind a WebSocket, built as the robotics projects build theirs (openpi's `WebsocketPolicyServer`).

An asyncio server of the `websockets` package without compression; the first message is metadata; then one observation
in, one action out, dicts of numpy arrays packed by `msgpack`, and the policy is called on the event loop. It is a peer
to measure against and not a way to serve: nothing here is bounded, and it listens on loopback only. Needs `websockets`,
which comes with the extra `server`, and for the policy `transformers` the extra `peers`.

`python -m benchmarks.policy_server` prints its port and serves until its stdin ends.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import msgpack
import numpy as np
import tyro
from websockets.asyncio.server import ServerConnection, serve
from websockets.sync.client import ClientConnection, connect

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle

__all__ = ["Behind", "PolicyClient", "PolicyServer", "policy_server"]

Behind = Literal["transformers", "bots"]
Policy = Callable[[dict[str, Any]], dict[str, Any]]

_HOST = "127.0.0.1"
_STOP_S = 10.0


@dataclass(frozen=True)
class PolicyServer:
    """Serve a policy over a WebSocket on a free port of loopback."""

    policy: Behind
    bundle: Path = Path("bundles/hard")  # whose sizes the policy has, or which it is


def pack(message: dict[str, Any]) -> bytes:
    """Dicts of numbers and numpy arrays as msgpack: an array is a dict of its bytes, dtype and shape."""
    return msgpack.packb(message, default=_array_as_dict)


def unpack(data: bytes) -> dict[str, Any]:
    """What `pack` packed; arrays are read-only views of the message."""
    return msgpack.unpackb(data, object_hook=_dict_as_array)


class PolicyClient:
    """The blocking client of such a server, inside a `with` block. Raises OSError and websockets.ConnectionClosed."""

    metadata: dict[str, Any]

    def __init__(self, port: int) -> None:
        self._connecting = connect(f"ws://{_HOST}:{port}", compression=None, max_size=None)

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """One observation out, its action back."""
        self._socket.send(pack(observation))
        return unpack(self._socket.recv())

    def __enter__(self) -> Self:
        self._socket: ClientConnection = self._connecting.__enter__()
        self.metadata = unpack(self._socket.recv())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connecting.__exit__(kind, error, trace)


class Serving(NamedTuple):
    """A server that runs: its process and where it listens."""

    pid: int
    port: int


@contextmanager
def policy_server(policy: Behind, bundle: Path) -> Iterator[Serving]:
    """Such a server in a process of its own, which ends with the `with` block or with this process."""
    command = [sys.executable, "-m", "benchmarks.policy_server", "--policy", policy, "--bundle", str(bundle)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            port = process.stdout.readline()
            if not port:
                raise RuntimeError(f"the policy server for {policy} did not start; it says why above")
            yield Serving(process.pid, int(port))
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


def bots_policy(bundle_path: Path) -> Policy:
    """Our own bots behind the same server, two calls a turn: {frame, free} gives {query}, {frame, query, costly} gives
    {action}. One company of bots for each number of them."""
    bundle, companies = Bundle.load(bundle_path), dict[int, tuple[Bots, np.ndarray]]()

    def infer(observation: dict[str, Any]) -> dict[str, Any]:
        n_bots = len(observation["free"] if "free" in observation else observation["query"])
        if n_bots not in companies:
            bots = Bots(bundle, max_bots=n_bots)
            companies[n_bots] = bots, bots.start(n_bots)
        bots, handles = companies[n_bots]
        frame = observation["frame"]
        if "free" in observation:
            return {"query": bots.request_queries(handles, frame, observation["free"]).query_NM}
        return {"action": bots.submit_features(handles, frame, observation["query"], observation["costly"]).action_NA}

    return infer


def transformers_policy(bundle_path: Path) -> Policy:
    """Hugging Face's model of the bundle's sizes: {observation, reward} gives {action}."""
    from benchmarks.peer_policies import HuggingFace  # torch only where it is asked for

    manifest, models = Bundle.load(bundle_path).manifest, dict[int, HuggingFace]()

    def infer(observation: dict[str, Any]) -> dict[str, Any]:
        observation_NO = np.array(observation["observation"])  # torch wants its arrays writeable
        n_bots = len(observation_NO)
        if n_bots not in models:
            models[n_bots] = HuggingFace(manifest, n_bots)
        return {"action": models[n_bots].act(observation_NO, observation["reward"])}

    return infer


async def run(policy: Policy, metadata: dict[str, Any]) -> None:
    """Serve until stdin ends."""

    async def converse(socket: ServerConnection) -> None:
        await socket.send(pack(metadata))
        async for message in socket:
            begun = time.monotonic()
            action = policy(unpack(message))
            action["server_timing"] = {"infer_ms": 1e3 * (time.monotonic() - begun)}
            await socket.send(pack(action))

    async with serve(converse, _HOST, 0, compression=None, max_size=None) as server:
        print(next(iter(server.sockets)).getsockname()[1], flush=True)
        await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)


def _array_as_dict(value: Any) -> dict[bytes, Any]:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    raise TypeError(f"cannot pack {type(value)}")


def _dict_as_array(value: dict[Any, Any]) -> Any:
    if b"__ndarray__" in value:
        return np.ndarray(buffer=value[b"data"], dtype=np.dtype(value[b"dtype"]), shape=value[b"shape"])
    return value


def main() -> None:
    """Command line."""
    config = tyro.cli(PolicyServer, description=__doc__)
    make = bots_policy if config.policy == "bots" else transformers_policy
    asyncio.run(run(make(config.bundle), {"policy": config.policy}))


if __name__ == "__main__":
    main()
