"""Whole turns by every door, against the bots themselves; retries; and refusals that change nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.client import BotClient, Welcome
from protocol.errors import (
    BadSchema,
    BadShape,
    FrameReused,
    MissingFeature,
    NoBot,
    NonFinite,
    NoPendingQuery,
    OutOfRange,
    ProtocolError,
    StaleFrame,
    UnrequestedFeature,
)
from protocol.features import CostModel
from protocol.transport import open_transport
from tests.protocol.golden import TABLE
from tests.server.serving import Served, costly_numbers, free_numbers, http_request, play, same

N = 3
SEEDS = [5, 6, 7]


def test_turns_over_any_door_are_the_bots_own(client: BotClient, bundle: Path) -> None:
    played = play(client, TABLE, client.start(N, seeds=SEEDS), range(12))
    bots = Bots(Bundle.load(bundle))
    handles = bots.start(N, seeds=SEEDS)
    asked = 0
    for frame, got in enumerate(played):
        queries = bots.request_queries(handles, frame, free_numbers(TABLE, N, frame), np.full(N, 0.25))
        wanted = bots.submit_features(handles, frame, queries.query_NM, costly_numbers(TABLE, N, frame))
        assert np.array_equal(got.actions, wanted.action_NA)
        assert np.array_equal(got.reasons, wanted.reasons_N)
        asked += int(queries.query_NM.sum())
    assert asked > 0
    assert any(not np.array_equal(a.actions, played[0].actions) for a in played)


def test_hello_says_what_is_served_and_the_engines_cost_model_counts(client: BotClient) -> None:
    welcome = client.welcome
    assert welcome.features == TABLE
    assert (welcome.bundle, welcome.context_length) == ("tiny", 4)
    assert welcome.cost_model == CostModel.declared(TABLE)
    assert welcome.budget_us == pytest.approx(0.6 * welcome.cost_model.full_us)


class Raw:
    """Exchanges bodies with a door, and keeps the connection's name for HTTP."""

    def __init__(self, address: str) -> None:
        self.transport = open_transport(address, 10.0)
        self.connection = None
        self.connection = self.ask({"type": "hello"})["connection"]

    def ask(self, message: dict) -> dict:
        return msgpack.unpackb(self.bytes(message))

    def bytes(self, message: dict) -> bytes:
        return self.transport.exchange(message["type"], msgpack.packb(message), self.connection)


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_retries_get_the_same_bytes_and_advance_nothing(served: Served, door: str) -> None:
    raw = Raw(served.addresses[door])
    bots = raw.ask({"type": "start_bots", "count": 2, "seeds": [1, 2]})["bots"]
    with BotClient(served.addresses[door]) as clean:
        clean.hello()
        once = play(clean, TABLE, clean.start(2, seeds=[1, 2]), range(8))
    for frame in range(8):
        free, costly = free_numbers(TABLE, 2, frame), costly_numbers(TABLE, 2, frame)
        query = {"type": "request_queries", "frame": frame, "bots": bots, "free": free.tobytes(), "rewards": [0.25] * 2}
        asked = raw.bytes(query)
        assert raw.bytes(query) == asked
        acquired = np.frombuffer(msgpack.unpackb(asked)["queries"], np.uint8).reshape(2, 2)
        bits = np.unpackbits(acquired, axis=1, count=TABLE.n_queries, bitorder="little").astype(bool)
        submit = {"type": "submit_features", "frame": frame, "bots": bots, "acquired": acquired.tobytes()}
        submit["values"] = costly[bits[:, TABLE.owner]].tobytes()
        acted = raw.bytes(submit)
        assert raw.bytes(submit) == acted
        assert raw.bytes(query) == asked
        assert msgpack.unpackb(acted)["actions"] == once[frame].actions.tobytes()
    raw.ask({"type": "goodbye"})
    raw.transport.close()


def test_json_turns_are_the_msgpack_turns(served: Served) -> None:
    http = served.addresses["http"]

    def post(path: str, message: dict, connection: str = "") -> dict:
        headers = {"Content-Type": "application/json; charset=utf-8", "X-Bot-Connection": connection}
        answer = http_request(http, "POST", path, json.dumps(message), headers)
        assert (answer.status, answer.headers["content-type"]) == (200, "application/json")
        return json.loads(answer.body)

    connection = post("/v1/connections", {})["connection"]
    bots = post("/v1/bots/start", {"count": 2, "seeds": [1, 2]}, connection)["bots"]
    with BotClient(http) as client:
        client.hello()
        once = play(client, TABLE, client.start(2, seeds=[1, 2]), range(4))
    for frame in range(4):
        free, costly = free_numbers(TABLE, 2, frame), costly_numbers(TABLE, 2, frame)
        query = {"frame": frame, "bots": bots, "free": free.tolist(), "rewards": [0.25, 0.25]}
        queries = post("/v1/query", query, connection)
        mask = np.array(queries["queries"], dtype=bool)[:, TABLE.owner]
        values = [row[kept].tolist() for row, kept in zip(costly, mask, strict=True)]
        submit = {"frame": frame, "bots": bots, "acquired": queries["queries"], "values": values}
        actions = post("/v1/act", submit, connection)
        assert post("/v1/act", submit, connection) == actions
        assert np.array_equal(np.array(actions["actions"], np.float32), once[frame].actions)
    assert post("/v1/bots/stop", {"bots": bots}, connection) == {"type": "bots_stopped", "count": 2}
    assert post("/v1/connections/close", {}, connection) == {"type": "farewell"}


def _changed(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[0] = value
    return array


def test_refused_requests_change_nothing(client: BotClient, welcome: Welcome) -> None:
    """THREATS: after any refused frame the next actions are byte-identical to a run without it."""
    clean = play(client, TABLE, client.start(N, seeds=SEEDS), range(1, 15))
    bots = client.start(N, seeds=SEEDS)
    played = play(client, TABLE, bots, range(1, 5))
    for frame in range(5, 15):
        free, costly = free_numbers(TABLE, N, frame), costly_numbers(TABLE, N, frame)
        none = np.zeros((N, TABLE.n_queries), dtype=bool)
        _refused(NoPendingQuery, client.act, bots, frame, none, costly)
        _refused(StaleFrame, client.query, bots, frame - 2, free)
        _refused(StaleFrame, client.act, bots, frame - 2, none, costly)
        _refused(NonFinite, client.query, bots, frame, _changed(free, np.nan))
        _refused(NonFinite, client.query, bots, frame, free, [0, 0, np.inf])
        _refused(OutOfRange, client.query, bots, frame, _changed(free, 100.5))
        _refused(OutOfRange, client.query, bots, frame, free, frame_budget_us=-1.0)
        _refused(BadShape, client.query, bots, frame, free, [0.0])
        _refused(BadSchema, client.query, bots, -1, free)
        _refused(BadSchema, client.query, [bots[0], bots[0], bots[1]], frame, free)
        _refused(BadSchema, client.stop, [bots[1], bots[1]])
        _refused(NoBot, client.query, [*bots[:2], bots[2] + 2**32], frame, free)
        queries = client.query(bots, frame, free, np.full(N, 0.25))
        asked = queries.queries
        _refused(FrameReused, client.query, bots, frame, free, np.full(N, 0.5))
        _refused(FrameReused, client.query, bots[::-1], frame, free[::-1], np.full(N, 0.25))
        _refused(NoPendingQuery, client.act, bots, frame + 1, asked, costly)
        _refused(NoPendingQuery, client.act, bots[:2], frame, asked[:2], costly[:2])
        _refused(UnrequestedFeature, client.act, bots, frame, np.ones_like(asked), costly)
        _refused(MissingFeature, client.act, bots, frame, none, costly)
        _refused(UnrequestedFeature, client.act, bots, frame, asked, costly, failed=~asked)
        for bad, refusal in ((np.nan, NonFinite), (-1.0, OutOfRange)):
            _refused(refusal, client.act, bots, frame, asked, np.full_like(costly, bad))
        played.append(client.act(bots, frame, asked, costly))
        _refused(NoPendingQuery, client.act, bots[:1], frame, asked[:1], costly[:1])
        _refused(FrameReused, client.act, bots, frame, asked, costly_numbers(TABLE, N, 99))
    assert same(played, clean)


def _refused(expected: type[ProtocolError], request: Callable[..., object], *args: Any, **kwargs: Any) -> None:
    with pytest.raises(expected) as refusal:
        request(*args, **kwargs)
    assert type(refusal.value) is expected
    assert refusal.value.detail


def test_failed_features_count_as_not_acquired_and_values_not_acquired_do_not_count(client: BotClient) -> None:
    def first(failing: bool, unread: float) -> np.ndarray:
        bots = client.start(N, seeds=SEEDS)
        queries = client.query(bots, 0, free_numbers(TABLE, N, 0)).queries
        costly = np.where(queries[:, TABLE.owner], costly_numbers(TABLE, N, 0), np.float32(unread))
        acquired = queries & ~failing
        return client.act(bots, 0, acquired, costly, failed=queries if failing else None).actions

    assert np.array_equal(first(False, 0.0), first(False, 49.0))
    assert np.array_equal(first(True, 0.0), first(True, 49.0))
    assert not np.array_equal(first(True, 0.0), first(False, 0.0))


def test_stopping_a_bot_of_a_pending_query_leaves_the_others_to_their_next_frame(client: BotClient) -> None:
    bots = client.start(N, seeds=SEEDS)
    queries = client.query(bots, 0, free_numbers(TABLE, N, 0)).queries
    client.stop(bots[:1])
    _refused(NoBot, client.act, bots, 0, queries, costly_numbers(TABLE, N, 0))
    _refused(NoPendingQuery, client.act, bots[1:], 0, queries[1:], costly_numbers(TABLE, N, 0)[1:])
    _refused(FrameReused, client.query, bots[1:], 0, free_numbers(TABLE, N, 0)[1:])
    assert not play(client, TABLE, bots[1:], range(1, 2))[0].reasons.any()


def test_skipped_frames_and_abandoned_queries_are_legal(client: BotClient) -> None:
    bots = client.start(1)
    client.query(bots, 3, free_numbers(TABLE, 1, 3))
    queries = client.query(bots, 2**53, free_numbers(TABLE, 1, 4))
    assert client.act(bots, 2**53, queries.queries, costly_numbers(TABLE, 1, 4)).frame == 2**53
