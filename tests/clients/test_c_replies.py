"""What the C client takes for a reply, each in memory of exactly its size: golden ones, and a great many others."""

from __future__ import annotations

import random
import struct
import subprocess
from pathlib import Path
from typing import Any

import msgpack
import pytest

from protocol.replies import read_actions, read_bots_started, read_queries, read_reply, read_welcome
from tests.clients.faults import mutated, plain, without
from tests.protocol.golden import REPLIES, TABLE, VECTORS

ASKED = {"welcome": "h", "bots_started": "s", "queries": "q", "actions": "a", "bots_stopped": "t", "farewell": "g"}
N_MUTANTS = 20_000
BAD_FIELDS = {
    "queries": {
        "frame": [7.5, "7", None, -7, 2**64 - 1],
        "queries": [b"", b"\1\2\3", b"\1\2\3\0\0", b"\0\4\0\0", "1230", None],
        "cost_us": [[1.0], [1.0, 2.0, 3.0], [1.0, "2"], [float("inf"), 0.0], [-1.0, 0.0], b"ab", None],
        "infer_us": [None, "1", float("nan"), -1.0],
        "reasons": [[0], [0, 256], [0, -1], [0, 0.5], b"\0\0", []],
        "late": [1, "yes"],
    },
    "actions": {
        "frame": [None, 6],
        "actions": [b"", b"\0" * 15, b"\0" * 17, struct.pack("<4f", 0, 0, 0, float("nan")), None, [[0.0, 0.0]] * 2],
        "reasons": [None, [0], [0, 0, 0], [0, 999]],
        "infer_us": [None, float("inf")],
        "turns": [[1], [1, -1], [1, 2**63], "12"],
        "late": ["no"],
    },
}
BAD_ACTIONS = [struct.pack("<4f", *row) for row in ([1.5, 0, 0, 0], [0, 0, 0, -0.5], [float("inf"), 0, 0, 0])]


def letters(built: Path, cases: list[tuple[str, bytes]], *, is_served: bool = False) -> str:
    """What `mutants` says of each body: `.` read, `r` refused by the server, `x` no reply. None of them ends it."""
    first = [] if is_served else [("h", VECTORS["welcome"].body)]
    stream = b"".join(kind.encode() + struct.pack("<I", len(body)) + body for kind, body in (*first, *cases))
    done = subprocess.run([built / "mutants"], input=stream, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()[len(first) :]


@pytest.mark.parametrize("name", BAD_FIELDS)
def test_a_field_of_another_type_length_or_range_is_an_error(name: str, built: Path) -> None:
    wrong = [  # each last in its message, so that nothing follows it that could be read for it
        {**without(name, field), field: value} for field, values in BAD_FIELDS[name].items() for value in values
    ]
    wrong += [without(name, field) for field in ("frame", "infer_us", name)]
    wrong += [plain("actions", actions=blob) for blob in BAD_ACTIONS] if name == "actions" else []
    assert set(letters(built, [(ASKED[name], msgpack.packb(message)) for message in wrong])) == {"x"}


def serving(*table: dict[str, Any]) -> dict[str, Any]:
    """The golden welcome, but of these features, and with as many costs as they need."""
    costs = [1.0 for feature in table if feature["cost_us"] != 0.0]
    return plain("welcome", features={"features": table}, cost_model={"call_us": 0.0, "feature_us": costs})


def test_a_welcome_is_held_to_what_the_protocol_allows(built: Path) -> None:
    feature, component = plain("welcome")["features"]["features"][1], plain("welcome")["action"]["components"][0]
    free = [{**feature, "name": f"free_{i}", "cost_us": 0.0} for i in range(1025)]
    right = [serving(feature), serving(*free[:-1]), serving({**feature, "size": 4096}), plain("welcome", max_bots=0)]
    bad = {
        "size": [0, 4097, 1.0, None],
        "low": [1e39, float("nan"), None, feature["high"]],
        "high": [-1e39, float("inf"), feature["low"]],
        "cost_us": [-1.0, float("nan"), 1e7],
        "name": ["", "x" * 65, "a b", "a-b", "1a", "é", 1],
    }
    wrong = [serving(), serving(*free), serving(feature, feature)]
    wrong += [serving({**feature, field: value}) for field, values in bad.items() for value in values]
    wrong += [serving({name: value for name, value in feature.items() if name != field}) for field in ("size", "low")]
    actions = [[], [component] * 1025, [{**component, "safe": 2.0}], [{**component, "low": 1.0}]]
    wrong += [plain("welcome", action={"components": each}) for each in actions]
    costs = [{"call_us": 1.0}, {"call_us": -1.0, "feature_us": [1.0] * 10}, {"call_us": 0.0, "feature_us": [1.0] * 9}]
    costs += [{"feature_us": [1.0] * 10}, {"call_us": 0.0, "feature_us": [-1.0] * 10}]
    wrong += [plain("welcome", cost_model=each) for each in (*costs, {}, None, [])]
    wrong += [plain("welcome", **{field: None}) for field in ("connection", "bundle", "max_bots", "budget_us")]
    wrong += [plain("welcome", **{field: "1"}) for field in ("target_cost_us", "deadline_us", "replay_frames")]
    wrong += [plain("welcome", connection="x" * 65), plain("welcome", bundle_sha256="x" * 65)]
    cases = [("h", VECTORS["welcome"].body), *(("h", msgpack.packb(message)) for message in (*right, *wrong))]
    assert letters(built, cases, is_served=True) == "." * (1 + len(right)) + "x" * len(wrong)


def is_well_formed(body: bytes) -> bool:
    """Whether the `msgpack` package finds one value here; it looks into texts and ext types too, which we skip."""
    try:
        msgpack.unpackb(body, raw=True, strict_map_key=False, ext_hook=lambda *_: None)
    except (ValueError, TypeError):
        return False
    return True


def test_thousands_of_mutated_replies_are_read_or_refused_within_their_bytes(built: Path) -> None:
    rng = random.Random(16)
    golden = [(ASKED.get(vector.message["type"], "q"), vector.body) for vector in REPLIES]
    bodies = [body for _, body in golden]
    assert letters(built, golden) == "".join("r" if b"error" in body else "." for body in bodies)
    cases = [(kind, mutated(body, bodies, rng)) for kind, body in (rng.choice(golden) for _ in range(N_MUTANTS))]
    verdicts = letters(built, cases)
    assert min(verdicts.count(letter) for letter in ".rx") > N_MUTANTS / 200
    for (kind, body), verdict in zip(cases, verdicts, strict=True):
        assert verdict == "x" or is_well_formed(body)
        assert verdict != "." or is_read_by_the_python_client(kind, body)


def is_read_by_the_python_client(kind: str, body: bytes) -> bool:
    request = {"h": "hello", "s": "start_bots", "q": "request_queries", "a": "submit_features", "t": "stop_bots"}
    try:
        msgpack.unpackb(body)
    except ValueError:
        return True  # texts that are not UTF-8, or odd keys, in what the C client does not look into
    golden, reply = read_welcome(plain("welcome")), read_reply(body, request.get(kind, "goodbye"))
    reply.pop("hidden", None)  # which the C client does not ask for
    match kind:
        case "h":
            read_welcome(reply)
        case "s":
            read_bots_started(reply, golden, 2)
        case "q":
            read_queries(reply, 2, TABLE)
        case "a":
            read_actions(reply, 2, golden.action)
    return True
