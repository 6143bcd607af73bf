"""Golden frames against the server's codec and against the client: two implementations, the same bytes."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from protocol import arrays, codec
from protocol.client import BotClient
from protocol.codec import Format
from protocol.errors import ProtocolError
from protocol.messages import Actions, Queries, Reply, Request, RequestQueries, SubmitFeatures, TakeTurn, Welcome
from protocol.replies import read_actions, read_bots_started, read_queries, read_reply, read_welcome
from protocol.transport import ReplyError
from protocol.vectors.__main__ import write_vectors
from tests.protocol.golden import BOTS, FOLDER, REFUSED, REPLIES, REQUESTS, TABLE, VECTORS, WELCOME, Vector

REPLY_TO = {
    "welcome": "hello",
    "bots_started": "start_bots",
    "queries": "request_queries",
    "actions": "submit_features",
    "bots_stopped": "stop_bots",
    "farewell": "goodbye",
    "error": "goodbye",
}


def name_of(vector: Vector) -> str:
    return vector.name


def test_the_committed_frames_are_what_the_script_writes(tmp_path: Path) -> None:
    write_vectors(tmp_path)
    written = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    committed = {path.name: path.read_bytes() for path in FOLDER.iterdir() if path.suffix in (".json", ".bin")}
    assert written == committed


def test_every_message_type_has_a_frame() -> None:
    named = {vector.message["type"] for vector in [*REQUESTS, *REPLIES]}
    assert named == {kind.__struct_config__.tag for kind in (*Request.__args__, *Reply.__args__)}


@pytest.mark.parametrize("vector", list(VECTORS.values()), ids=name_of)
def test_the_length_prefix_is_the_length(vector: Vector) -> None:
    assert struct.unpack(">I", vector.frame[:4]) == (len(vector.body),)


def _dense(message: Request | Reply) -> dict[str, Any]:
    """Every field as plain Python, its blobs as nested lists: what the vector's JSON says."""
    fields = msgspec.to_builtins(message, builtin_types=(bytes,))
    match message:
        case RequestQueries():
            fields["free"] = arrays.floats(message.free, (len(message.bots), TABLE.n_free), "free").tolist()
        case SubmitFeatures() | TakeTurn():
            if isinstance(message, TakeTurn):
                fields["free"] = arrays.floats(message.free, (len(message.bots), TABLE.n_free), "free").tolist()
            shape = len(message.bots), TABLE.n_queries
            acquired = arrays.bits(message.acquired, shape, "acquired")
            dense = arrays.unpack_values(message.values, acquired, TABLE)
            fields["values"] = [row[mask].tolist() for row, mask in zip(dense, acquired[:, TABLE.owner], strict=True)]
            fields["acquired"] = acquired.astype(int).tolist()
            if message.failed is not None:
                fields["failed"] = arrays.bits(message.failed, shape, "failed").astype(int).tolist()
        case Queries():
            fields["queries"] = (
                arrays.bits(message.queries, (len(BOTS), TABLE.n_queries), "queries").astype(int).tolist()
            )
        case Actions():
            fields["actions"] = arrays.floats(message.actions, (len(BOTS), WELCOME.action.size), "actions").tolist()
            if message.hidden is not None:
                fields["hidden"] = arrays.floats(message.hidden, (len(BOTS), 3), "hidden").tolist()
    return json.loads(json.dumps(fields))


def _narrowed(value: Any) -> Any:
    """What the message says once its blobs have been float32."""
    if isinstance(value, dict):
        return {k: np_floats(v) if k in ("free", "values", "actions") else v for k, v in value.items()}
    return value


def np_floats(rows: list[list[float]]) -> list[list[float]]:
    return [np.array(row, dtype=np.float32).tolist() for row in rows]


@pytest.mark.parametrize("vector", REQUESTS, ids=name_of)
def test_the_server_reads_requests_field_for_field_in_both_formats(vector: Vector) -> None:
    for form, body in ((Format.MSGPACK, vector.body), (Format.JSON, json.dumps(vector.message).encode())):
        fields = _dense(codec.decode_request(body, form))
        given = {name: value for name, value in fields.items() if name in vector.message}
        assert given == _narrowed(vector.message)
        assert all(value is None or value is False for name, value in fields.items() if name not in vector.message)


@pytest.mark.parametrize("vector", REPLIES, ids=name_of)
def test_the_server_writes_replies_byte_for_byte(vector: Vector) -> None:
    reply = msgspec.json.decode(json.dumps(vector.message), type=Reply)
    match reply:
        case Queries():
            query_NM = np.array(reply.queries, dtype=bool)
            reply = msgspec.structs.replace(reply, queries=arrays.pack_bits(query_NM, Format.MSGPACK))
        case Actions():
            action_NA = np.array(reply.actions, dtype=np.float32)
            reply = msgspec.structs.replace(reply, actions=arrays.pack_floats(action_NA, Format.MSGPACK))
            if reply.hidden is not None:
                hidden = arrays.pack_floats(np.array(reply.hidden, dtype=np.float32), Format.MSGPACK)
                reply = msgspec.structs.replace(reply, hidden=hidden)
    assert codec.encode(reply, Format.MSGPACK) == vector.body


class Recorder:
    """A transport that keeps what is sent and answers golden replies."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def exchange(self, kind: str, body: bytes, connection: str | None) -> bytes:
        self.sent.append(body)
        answers = {asked: reply for reply, asked in REPLY_TO.items() if reply != "error"} | {"take_turn": "actions"}
        return VECTORS[answers[kind]].body

    def close(self) -> None:
        pass


def _client() -> tuple[BotClient, Recorder]:
    client, recorder = BotClient("tcp://127.0.0.1:1"), Recorder()
    client._transport = recorder
    client.hello()
    return client, recorder


def _submission(vector: Vector) -> dict[str, Any]:
    acquired = np.array(vector.message["acquired"], dtype=bool)
    costly = np.full((len(BOTS), TABLE.n_costly), 49.0, dtype=np.float32)
    costly[acquired[:, TABLE.owner]] = np.concatenate([np.array(row, np.float32) for row in vector.message["values"]])
    optional = {name: vector.message.get(name) for name in ("failed", "acquire_us", "hidden")}
    return {"bots": BOTS, "frame": 7, "acquired": acquired, "costly": costly, **optional}


def test_the_client_writes_requests_byte_for_byte() -> None:
    client, recorder = _client()
    client.hello(cost_model=WELCOME.cost_model, token="s3cret é")
    client.hello(bundle="golden@3")
    client.start(2)
    client.start(2, seeds=[1, 2**63 - 1], target_returns=[100, 50.5], budgets_us=[20, 0], target_costs_us=[4.5, 0])
    client.start(2, seeds=[3, 4], turns=[0, 2**53])
    client.act(**_submission(VECTORS["submit_features"]))
    client.act(**_submission(VECTORS["submit_features_failed"]))
    client.act(**_submission(VECTORS["submit_features_measured"]))
    client.act(**_submission(VECTORS["submit_features_hidden"]))
    client.act(**_submission(VECTORS["submit_features_deadline"]), deadline_us=8000)
    client.stop(BOTS)
    client.close()
    names = ["hello", "hello_cost_model_token", "hello_bundle", "start_bots", "start_bots_all", "start_bots_turns"]
    names += ["submit_features", "submit_features_failed", "submit_features_measured"]
    names += ["submit_features_hidden", "submit_features_deadline", "stop_bots", "goodbye"]
    assert recorder.sent == [VECTORS[name].body for name in names]


@pytest.mark.parametrize("name", ["take_turn", "take_turn_all", "take_turn_replayed"])
def test_the_client_writes_whole_turns_byte_for_byte(name: str) -> None:
    client, recorder = _client()
    said = VECTORS[name].message
    optional = {key: said.get(key) for key in ("rewards", "frame_budget_us", "budgets_us", "target_costs_us")}
    optional["replayed_returns_to_go"] = said.get("replayed_returns_to_go")
    optional["deadline_us"] = said.get("deadline_us")
    client.take(free=said["free"], **_submission(VECTORS[name]), **optional)
    assert recorder.sent[-1] == VECTORS[name].body


@pytest.mark.parametrize("name", ["request_queries", "request_queries_all"])
def test_the_client_writes_queries_byte_for_byte_and_refuses_another_frames_answer(name: str) -> None:
    client, recorder = _client()
    asked = {key: value for key, value in VECTORS[name].message.items() if key != "type"}
    with pytest.raises(ConnectionError, match="frame 7"):
        client.query(**asked)
    assert recorder.sent[-1] == VECTORS[name].body


def test_the_client_reads_replies_field_for_field() -> None:
    for name in ("welcome", "welcome_no_context_target_cost"):
        welcome = read_welcome(read_reply(VECTORS[name].body, "hello"))
        said = msgspec.convert(VECTORS[name].message, Welcome)
        assert welcome._asdict() == {name: getattr(said, name) for name in welcome._fields}
    reply = read_reply(VECTORS["bots_started"].body, "start_bots")
    handles, started = read_bots_started(reply, welcome, len(BOTS))
    with pytest.raises(ReplyError):
        read_bots_started(reply, welcome, len(BOTS) - 1)
    assert handles.tolist() == BOTS
    assert (welcome.bundle_version, started.bundle_version) == (None, 3)
    assert started == welcome._replace(bundle_version=3, bundle_sha256=WELCOME.bundle_sha256)
    said = VECTORS["queries"].message
    queries = read_queries(read_reply(VECTORS["queries"].body, "request_queries"), 2, TABLE)
    assert queries.queries.astype(int).tolist() == said["queries"]
    assert (queries.frame, queries.cost_us.tolist(), queries.infer_us) == (7, said["cost_us"], said["infer_us"])
    said = VECTORS["actions"].message
    actions = read_actions(read_reply(VECTORS["actions"].body, "submit_features"), 2, WELCOME.action)
    assert (actions.actions.tolist(), actions.reasons.tolist()) == (said["actions"], said["reasons"])
    assert (actions.turns.tolist(), actions.hidden) == (said["turns"], None)
    said = VECTORS["actions_hidden"].message
    actions = read_actions(read_reply(VECTORS["actions_hidden"].body, "take_turn"), 2, WELCOME.action)
    assert (actions.turns.tolist(), actions.hidden.tolist()) == (said["turns"], said["hidden"])
    assert read_reply(VECTORS["bots_stopped"].body, "stop_bots")["count"] == 2


@pytest.mark.parametrize("vector", [v for v in REPLIES if v.message["type"] == "error"], ids=name_of)
def test_the_client_raises_the_error_that_the_server_names(vector: Vector) -> None:
    with pytest.raises(ProtocolError) as refusal:
        read_reply(vector.body, "stop_bots")
    assert refusal.value.code == vector.message["code"]
    assert (refusal.value.detail, refusal.value.retry_after_s) == (
        vector.message["detail"],
        vector.message["retry_after_s"],
    )


def _read(body: bytes) -> None:
    request = codec.decode_request(body, Format.MSGPACK)
    match request:
        case RequestQueries():
            arrays.floats(request.free, (len(request.bots), TABLE.n_free), "free")
        case SubmitFeatures() | TakeTurn():
            acquired = arrays.bits(request.acquired, (len(request.bots), TABLE.n_queries), "acquired")
            arrays.unpack_values(request.values, acquired, TABLE)


READABLE = {
    "NON_FINITE",
    "OUT_OF_RANGE",
    "OVER_BUDGET",
}  # the bots refuse these: tests/server has them against a real server


@pytest.mark.parametrize("vector", REFUSED, ids=name_of)
def test_refused_frames_are_refused_with_their_code(vector: Vector) -> None:
    code = vector.description["refused_with"]
    if code in READABLE:
        _read(vector.body)
        return
    with pytest.raises(ProtocolError) as refusal:
        _read(vector.body)
    assert refusal.value.code == code
