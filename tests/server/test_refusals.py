"""After any refused request the next 20 actions are byte-identical to a run without it, whatever the error's code.

Each code is provoked over HTTP, between two turns and within one, by what an engine or somebody else might send.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgpack
import numpy as np
import pytest

from bot_runtime.policy import Policy
from protocol.client import BotClient, Queries
from protocol.errors import ERRORS_BY_CODE
from tests.protocol.golden import TABLE
from tests.server.serving import Served, costly_numbers, free_numbers, http_request, serve

TOKEN = "a token"
SEEDS = [11, 12]
N = len(SEEDS)
MAX_BOTS = 8
MAX_CONNECTIONS = 2
BEFORE, AFTER = 4, 20
# What no request of an engine is answered with: provoked elsewhere.
ELSEWHERE = {
    "BAD_BUNDLE": "tests/bot_runtime/test_bundle.py: when a bundle is loaded",
    "NOT_READY": "tests/server/test_busy.py: a full queue, before the request is looked at",
}


class Engine(NamedTuple):
    """What an engine needs to provoke an error: its server, its client, its bots, the frame and what is pending."""

    served: Served
    client: BotClient
    bots: np.ndarray
    frame: int
    pending: Queries | None
    monkeypatch: pytest.MonkeyPatch

    def post(
        self, path: str, body: Any, connection: str | None = "", form: str = "msgpack", method: str = "POST"
    ) -> str:
        """The code of the answer to a body, packed unless it is bytes; by this connection unless another is given."""
        packed = body if isinstance(body, bytes) else msgpack.packb(body)
        connection = self.client.welcome.connection if connection == "" else connection
        headers = {"Content-Type": f"application/{form}", "Accept": "application/json"}
        headers |= {} if connection is None else {"X-Bot-Connection": connection}
        answer = http_request(self.served.addresses["http"], method, path, packed, headers)
        said = json.loads(answer.body)
        assert said["type"] == "error", said
        assert answer.status == ERRORS_BY_CODE[said["code"]].status
        return said["code"]

    def query(self, **changes: Any) -> str:
        """A query of the next frame, changed."""
        free = free_numbers(TABLE, N, self.frame).tobytes()
        message = {"frame": self.frame, "bots": self.bots.tolist(), "free": free, "rewards": [0.25] * N}
        return self.post("/v1/query", message | changes)

    def act(self, **changes: Any) -> str:
        """An answer to the query that is pending, or to that of the frame before again, changed."""
        nothing = np.zeros((N, TABLE.n_queries), dtype=bool)
        asked = nothing if self.pending is None else self.pending.queries
        values = costly_numbers(TABLE, N, self.frame)[asked[:, TABLE.owner]]
        message = {"frame": self.frame, "bots": self.bots.tolist(), "values": values.tobytes()}
        return self.post("/v1/act", message | {"acquired": _bits(asked)} | changes)

    def over_budget(self) -> str:
        """A whole turn of the next frame in which everything was acquired, with a budget for nothing."""
        free = free_numbers(TABLE, N, self.frame + 1).tobytes()
        message = {"frame": self.frame + 1, "bots": self.bots.tolist(), "free": free, "budgets_us": [0.0] * N}
        return self.post("/v1/turn", message | {"acquired": ALL, "values": EVERY_VALUE})


def _bits(array_NM: np.ndarray) -> bytes:
    return np.packbits(array_NM, axis=1, bitorder="little").tobytes()


def _internal(engine: Engine) -> str:
    def fail(*_: object) -> None:
        raise MemoryError

    with engine.monkeypatch.context() as broken:
        broken.setattr(Policy, "query_probs", fail)
        broken.setattr(Policy, "act", fail)
        return engine.query(frame=engine.frame + 1)


def _too_many_connections(engine: Engine) -> str:
    with BotClient(engine.served.addresses["http"]) as other:
        other.hello(token=TOKEN)
        return engine.post("/v1/connections", {"token": TOKEN}, None)


NAN = np.full((N, TABLE.n_free), np.nan, dtype=np.float32).tobytes()
ALL = _bits(np.ones((N, TABLE.n_queries), dtype=bool))
EVERY_VALUE = np.full((N, TABLE.n_costly), 1.0, dtype=np.float32).tobytes()
Provoked = Callable[[Engine], str]
BETWEEN: dict[str, Provoked] = {
    "BAD_MSGPACK": lambda engine: engine.post("/v1/query", b"\xc1"),
    "BAD_JSON": lambda engine: engine.post("/v1/query", b"{", form="json"),
    "TOO_DEEP": lambda engine: engine.post("/v1/query", b"\x91" * 5000),
    "BAD_SCHEMA": lambda engine: engine.query(surprise=1),
    "BAD_SHAPE": lambda engine: engine.query(free=b"\0" * 4),
    "NON_FINITE": lambda engine: engine.query(free=NAN),
    "OUT_OF_RANGE": lambda engine: engine.query(rewards=[1e300, 0.0]),
    "STALE_FRAME": lambda engine: engine.query(frame=0),
    "NO_PENDING_QUERY": lambda engine: engine.act(frame=engine.frame + 1),
    "NO_BOT": lambda engine: engine.query(bots=[int(engine.bots[0]), 2**62]),
    "NO_CONNECTION": lambda engine: engine.post("/v1/bots/stop", {"bots": engine.bots.tolist()}, "0" * 32),
    "NO_BUNDLE": lambda engine: engine.post("/v1/connections", {"token": TOKEN, "bundle": "another"}, None),
    "UNAUTHORIZED": lambda engine: engine.post("/v1/connections", {"token": "guessed"}, None),
    "TOO_MANY_BOTS": lambda engine: engine.post("/v1/bots/start", {"count": MAX_BOTS}),
    "TOO_MANY_CONNECTIONS": _too_many_connections,
    "TOO_LARGE": lambda engine: engine.post("/v1/query", bytes(engine.client.welcome.max_body_bytes + 1)),
    "UNSUPPORTED_MEDIA_TYPE": lambda engine: engine.post("/v1/query", b"", form="x-pickle"),
    "NO_ROUTE": lambda engine: engine.post("/v1/pickle", b""),
    "METHOD_NOT_ALLOWED": lambda engine: engine.post("/v1/query", b"", method="DELETE"),
    "OVER_BUDGET": Engine.over_budget,
    "INTERNAL": _internal,
}
# The rest is refused only while a query is pending; every error that is possible then is tried then as well.
WITHIN: dict[str, Provoked] = BETWEEN | {
    "FRAME_REUSED": lambda engine: engine.query(rewards=[0.5] * N),
    "UNREQUESTED_FEATURE": lambda engine: engine.act(acquired=ALL, values=EVERY_VALUE),
    "MISSING_FEATURE": lambda engine: engine.act(acquired=bytes(len(ALL)), values=b""),
    "NON_FINITE": lambda engine: engine.act(acquire_us=float("nan")),
    "OUT_OF_RANGE": lambda engine: engine.act(acquire_us=-1.0),
    "BAD_SHAPE": lambda engine: engine.act(values=b""),
    "STALE_FRAME": lambda engine: engine.act(frame=1),
}


@pytest.fixture(scope="module")
def guarded(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    limits = {"token": TOKEN, "max_bots": MAX_BOTS, "max_connections": MAX_CONNECTIONS}
    with serve(bundle, tmp_path_factory.mktemp("socket") / "s", **limits) as running:
        yield running


def _play(
    served: Served, between: list[Provoked], within: list[Provoked], monkeypatch: pytest.MonkeyPatch
) -> tuple[list[bytes], list[str]]:
    """The bytes of every query and action, and the codes that came; errors are provoked in the frame after `BEFORE`."""
    played, codes = [], []
    with BotClient(served.addresses["http"]) as client:
        client.hello(token=TOKEN)
        bots = client.start(N, seeds=SEEDS)
        for frame in range(2, 2 + BEFORE + AFTER):
            due = frame == 2 + BEFORE
            codes += [provoke(Engine(served, client, bots, frame, None, monkeypatch)) for provoke in between if due]
            asked = client.query(bots, frame, free_numbers(TABLE, N, frame), [0.25] * N)
            codes += [provoke(Engine(served, client, bots, frame, asked, monkeypatch)) for provoke in within if due]
            done = client.act(bots, frame, asked.queries, costly_numbers(TABLE, N, frame))
            played.append(asked.queries.tobytes() + asked.cost_us.tobytes() + done.actions.tobytes())
    assert len(set(played)) > BEFORE + AFTER - 3
    return played, codes


@pytest.fixture(scope="module")
def clean(guarded: Served) -> list[bytes]:
    with pytest.MonkeyPatch.context() as nothing:
        return _play(guarded, [], [], nothing)[0]


@pytest.mark.parametrize("code", BETWEEN)
def test_refused_between_two_turns(
    guarded: Served, clean: list[bytes], code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _play(guarded, [BETWEEN[code]], [], monkeypatch) == (clean, [code])


@pytest.mark.parametrize("code", WITHIN)
def test_refused_within_a_turn(guarded: Served, clean: list[bytes], code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert _play(guarded, [], [WITHIN[code]], monkeypatch) == (clean, [code])


def test_refused_all_at_once(guarded: Served, clean: list[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
    played, codes = _play(guarded, [*BETWEEN.values()], [*WITHIN.values()], monkeypatch)
    assert played == clean
    assert codes == [*BETWEEN, *WITHIN]


def test_every_code_is_provoked() -> None:
    assert set(WITHIN) | set(ELSEWHERE) == set(ERRORS_BY_CODE)
