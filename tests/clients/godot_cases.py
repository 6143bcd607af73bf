"""What the runner of clients/godot is given: bytes of msgpack, replies and servers that are no good, requests, rays."""

from __future__ import annotations

import base64
import random
import struct
from typing import Any

import msgpack

from tests.clients.fake_server import Conversation
from tests.clients.faults import frame_of, mutated, plain
from tests.protocol.golden import BOTS, REPLIES, VECTORS

SAID = ["hello", "hello_cost_model_token", "hello_bundle", "start_bots", "start_bots_all"]
SAID += ["request_queries", "request_queries_all", "submit_features", "submit_features_failed"]
SAID += ["submit_features_measured", "submit_features_deadline", "stop_bots", "goodbye"]


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def codec_cases() -> list[bytes]:
    golden = [vector.body for vector in VECTORS.values()]
    cut = [VECTORS[name].body[:end] for name in ("queries", "error_retry") for end in range(len(VECTORS[name].body))]
    rng, bodies = random.Random(0), [vector.body for vector in REPLIES]
    wild = [mutated(body, bodies, rng) for _ in range(20) for body in bodies]
    numbers = [msgpack.packb([sign * 2**bits + off for sign in (1, -1) for off in (-1, 0, 1)]) for bits in range(63)]
    sizes = [msgpack.packb([b"x" * size, "y" * size]) for size in (0, 15, 16, 31, 32, 255, 256, 65535, 65536)]
    sizes += [msgpack.packb({"x": [None] * size, **dict.fromkeys("abcdefghijklmnopqrst"[:size])}) for size in range(20)]
    narrow = [msgpack.packb(-0.1, use_single_float=True), msgpack.packb({"é": [float("inf"), -0.0]})]
    odd = [
        msgpack.packb(2**63),
        msgpack.packb("a\0b"),
        msgpack.packb({1: 2}),
        b"\x91" * 16 + b"\xc0",
        b"\x91" * 17 + b"\xc0",
    ]
    return golden + cut + wild + numbers + sizes + narrow + odd


def readable(body: bytes) -> tuple[bool, Any]:
    """Whether this client's subset of msgpack holds these bytes, and what they say."""
    try:
        value = msgpack.unpackb(body, strict_map_key=False)
    except (ValueError, TypeError):  # the package raises the latter for the key of a map that is a map
        return False, None
    return within(value, 0), value


def within(value: Any, depth: int) -> bool:
    if isinstance(value, dict):
        return depth < 16 and all(
            isinstance(k, str) and within(k, 0) and within(v, depth + 1) for k, v in value.items()
        )
    if isinstance(value, list):
        return depth < 16 and all(within(each, depth + 1) for each in value)
    if isinstance(value, str):
        return "\0" not in value
    if isinstance(value, int):
        return value < 2**63
    return value is None or isinstance(value, float | bytes)


def shown(value: Any) -> Any:
    """As the runner shows it."""
    match value:
        case bool() | None:
            return value
        case int():
            return f"i{value}"
        case float():
            return "f" + struct.pack(">d", value).hex()
        case str():
            return "s" + value.encode().hex()
        case bytes():
            return "b" + value.hex()
        case list():
            return [shown(each) for each in value]
    return {key.encode().hex(): shown(each) for key, each in value.items()}


WELCOME_FRAME, QUERIES_FRAME = VECTORS["welcome"].frame, VECTORS["queries"].frame
HOSTILE: dict[str, tuple[Conversation, tuple[Any, ...]]] = {  # what is said, and code, retry_after_s, is_open
    "refused": (Conversation([VECTORS["error"].frame]), ("NO_BOT", None, True)),
    "refused for now": (Conversation([VECTORS["error_retry"].frame]), ("TOO_MANY_BOTS", 1.0, True)),
    "a code from the future": (
        Conversation([frame_of({"type": "error", "code": "NEW", "detail": "?"})]),
        ("INTERNAL", None, True),
    ),
    "drop by drop": (Conversation([WELCOME_FRAME[:40], b""], drops=1), ("TIMED_OUT", None, False)),
    "whole, in drops": (Conversation([WELCOME_FRAME, QUERIES_FRAME], drops=100), (None, None, True)),
    "too long": (Conversation([b"\xff\xff\xff\xff"]), ("BAD_REPLY", None, False)),
    "a little too long": (Conversation([struct.pack(">I", 2**20 + 1)]), ("BAD_REPLY", None, False)),
    "too long for two bots": (Conversation([WELCOME_FRAME, struct.pack(">I", 70000)]), ("BAD_REPLY", None, False)),
    "cut": (Conversation([WELCOME_FRAME[:100]], closes=True), ("CONNECTION_LOST", None, False)),
    "cut in the length": (Conversation([WELCOME_FRAME[:3]], closes=True), ("CONNECTION_LOST", None, False)),
    "closed at once": (Conversation([], closes=True), ("CONNECTION_LOST", None, False)),
    "silent": (Conversation([b""]), ("TIMED_OUT", None, False)),
    "empty": (Conversation([b"\0\0\0\0"]), ("BAD_REPLY", None, False)),
    "garbage": (Conversation([b"\0\0\0\x03\xc1\xc1\xc1"]), ("BAD_REPLY", None, False)),
    "a bomb": (Conversation([b"\0\0\0\x05\xdd\xff\xff\xff\xff"]), ("BAD_REPLY", None, False)),
    "another reply": (Conversation([VECTORS["bots_started"].frame]), ("BAD_REPLY", None, False)),
    "two replies": (Conversation([WELCOME_FRAME + b"\0" * 9]), ("BAD_REPLY", None, False)),
    "cut later": (Conversation([WELCOME_FRAME, QUERIES_FRAME[:9]], closes=True), ("CONNECTION_LOST", None, False)),
    "another frame": (
        Conversation([WELCOME_FRAME, frame_of(plain("queries", frame=8))]),
        ("BAD_REPLY", None, False),
    ),
    "late": (Conversation([WELCOME_FRAME, QUERIES_FRAME]), (None, None, True)),
}


def _reply(name: str, **changed: Any) -> bytes:
    return bytes(msgpack.packb(plain(name, **changed)))


def wrong_replies() -> list[tuple[str, bytes]]:
    """Replies that are msgpack and wrong all the same, by what they answer."""
    inf = struct.pack("<4f", 0.0, float("inf"), 0.0, 0.0)
    features = VECTORS["welcome"].message["features"]["features"]
    tables = [[], features[:1] * 2, [{**features[0], "size": 0}], [{**features[0], "low": float("nan")}], [7], None]
    return [
        *(("hello", _reply("welcome", features={"features": table})) for table in tables),
        *(("hello", _reply("welcome", **{name: 7})) for name in ("features", "action", "cost_model")),
        ("hello", _reply("welcome", action={"components": []})),
        ("hello", _reply("welcome", cost_model={"call_us": 1.0, "feature_us": [1.0]})),
        ("hello", _reply("welcome", deadline_us="soon")),
        ("hello", _reply("welcome", max_body_bytes=None)),
        *(("start_bots", _reply("bots_started", bots=bots)) for bots in (None, [1], [1, 1], [1, -1], [1.0, 2.0])),
        *(("request_queries", _reply("queries", queries=bits)) for bits in (b"", b"\0\0\0", b"\0\x04\0\0", "\0\0\0\0")),
        *(("request_queries", _reply("queries", reasons=reasons)) for reasons in ([0], [0, 256], [0, None], 7)),
        *(("request_queries", _reply("queries", cost_us=costs)) for costs in (None, [1.0], [1.0, "1"])),
        ("request_queries", _reply("queries", infer_us=None)),
        ("request_queries", _reply("queries", frame=7.0)),
        *(("submit_features", _reply("actions", actions=blob)) for blob in (None, b"", b"\0" * 15, inf)),
        *(("submit_features", _reply("actions", reasons=reasons)) for reasons in (None, [0])),
        *(("submit_features", _reply("actions", turns=turns)) for turns in ([1], [1, "2"])),
        ("stop_bots", _reply("bots_stopped", count="2")),
        ("stop_bots", msgpack.packb([1, 2])),
        ("stop_bots", msgpack.packb({"count": 2})),
    ]


MESSAGES = {
    "hello": {"type": "hello"},
    "start_bots": {"type": "start_bots", "count": 2},
    "request_queries": {"type": "request_queries", "frame": 7, "bots": BOTS},
    "submit_features": {"type": "submit_features", "frame": 7, "bots": BOTS},
    "stop_bots": {"type": "stop_bots", "bots": BOTS},
}
ANSWERS = {
    "hello": "welcome",
    "start_bots": "bots_started",
    "request_queries": "queries",
    "submit_features": "actions",
    "stop_bots": "bots_stopped",
}
GOOD = [*ANSWERS.items(), ("request_queries", "queries_shed"), ("submit_features", "actions_late")]
GOOD += [("submit_features", "actions_hidden"), ("hello", "welcome_no_context_target_cost")]


def read_cases() -> list[dict[str, Any]]:
    good = [(asked, VECTORS[answer].body) for asked, answer in GOOD]
    rng, bodies = random.Random(1), [vector.body for vector in REPLIES]
    wild = [(asked, mutated(VECTORS[answer].body, bodies, rng)) for asked, answer in GOOD for _ in range(40)]
    return [{"message": MESSAGES[asked], "body": b64(body)} for asked, body in good + wrong_replies() + wild]


def answer_to(name: str) -> bytes:
    """A golden reply that fits the golden request."""
    message = VECTORS[name].message
    if message["type"] == "request_queries":
        n = len(message["bots"])
        return frame_of(plain("queries", frame=message["frame"], queries=b"\0" * 2 * n, cost_us=[0.0] * n))
    return VECTORS[{**ANSWERS, "goodbye": "farewell"}[message["type"]]].frame


def sayable(name: str) -> dict[str, Any]:
    message = dict(VECTORS[name].message)
    return {**message, "seeds": [str(seed) for seed in message["seeds"]]} if "seeds" in message else message


CLASSES = ["nothing", "ground", "wall", "lava"]
ROOM = [
    {"group": "own", "middle": [0, 0.7, 0], "half": [0.3, 0.7, 0.3]},
    {"group": "ground", "middle": [0, -0.5, 0], "half": [30, 0.5, 30]},
    {"group": "wall", "middle": [0, 1, -5], "half": [3, 1, 0.5]},
    {"group": "lava", "middle": [-6, 1, 0], "half": [1, 1, 1]},
    {"group": "unnamed", "middle": [3, 1, 3], "half": [0.5, 1, 0.5]},
]
FREE = {"name": "position", "size": 3, "cost_us": 0.0, "low": -1.0, "high": 1.0}
RAYS = {  # with a heading of 90 degrees to the left of -z, so ahead is -x: distance and class
    "ray_l000_d00_r010": (5.0, "lava"),
    "ray_r090_d00_r010": (4.5, "wall"),
    "ray_r180_d00_r010": (10.0, "nothing"),
    "ray_l180_d45_r005": (1.2 * 2**0.5, "ground"),
    "ray_r090_u45_r005": (5.0, "nothing"),
    "ray_r090_d00_r003": (3.0, "nothing"),
    "ray_l135_d00_r010": (2.5 * 2**0.5, "ground"),  # in no group that names a class
}


def rays_scenario() -> dict[str, Any]:
    features = [
        {"name": name, "size": 1 + len(CLASSES), "cost_us": 2.0, "low": 0.0, "high": float(name[-3:])} for name in RAYS
    ]
    return {"classes": CLASSES, "heading_deg": 90, "boxes": ROOM, "features": [FREE, *features]}
