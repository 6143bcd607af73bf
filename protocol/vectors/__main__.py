"""`python -m protocol.vectors` writes the golden frames: one `.json` that says what and one `.bin` of the very bytes.

This module knows nothing about `protocol.codec` or `protocol.client`, which are tested against what it writes: a frame
is made here with the `msgpack` package, straight from what PROTOCOL.md says.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

__all__ = ["write_vectors"]

_FLOATS = {"free", "values", "actions", "hidden"}
_BITS = {"queries", "acquired", "failed"}
_BOTS = [2**32, 2**32 + 1]

# M = 10 costly features, so that bits cross a byte: one of size 2, nine of size 1; D = 11, F = 3, A = 2.
_FEATURES = [
    {"name": "position", "size": 2, "cost_us": 0.0, "low": -100.0, "high": 100.0},
    {"name": "ray_00", "size": 2, "cost_us": 4.5, "low": 0.0, "high": 50.0},
    *({"name": f"ray_{i:02d}", "size": 1, "cost_us": 1.5, "low": 0.0, "high": 50.0} for i in range(1, 10)),
    {"name": "on_ground", "size": 1, "cost_us": 0.0, "low": 0.0, "high": 1.0},
]
_ACTION = [
    {"name": "turn", "low": -1.0, "high": 1.0, "safe": 0.0},
    {"name": "jump", "low": 0.0, "high": 1.0, "safe": 0.0},
]
_COST_MODEL = {"call_us": 16.0, "feature_us": [4.5, *[1.5] * 9]}
_FREE = [[1.5, -2.25, 1.0], [100.0, 0.0, 0.0]]
_QUERIES = [[1, 0, 0, 0, 0, 0, 0, 0, 1, 1], [0, 1, 0, 0, 0, 0, 0, 0, 0, 0]]
_SUBMIT = {"type": "submit_features", "frame": 7, "bots": _BOTS, "acquired": _QUERIES}

_TURN = {
    "type": "take_turn",
    "frame": 7,
    "bots": _BOTS,
    "free": _FREE,
    "acquired": _QUERIES,
    "values": [[10.0, 1.0, 8.5, 9.5], [0.1]],
}

REQUESTS: dict[str, dict[str, Any]] = {
    "hello": {"type": "hello", "protocol": 1},
    "hello_cost_model_token": {"type": "hello", "protocol": 1, "cost_model": _COST_MODEL, "token": "s3cret é"},
    "hello_bundle": {"type": "hello", "protocol": 1, "bundle": "golden@3"},
    "start_bots": {"type": "start_bots", "count": 2},
    "start_bots_all": {
        "type": "start_bots",
        "count": 2,
        "seeds": [1, 2**63 - 1],
        "target_returns": [100.0, 50.5],
        "budgets_us": [20.0, 0.0],
        "target_costs_us": [4.5, 0.0],
    },
    "start_bots_turns": {"type": "start_bots", "count": 2, "seeds": [3, 4], "turns": [0, 2**53]},
    "request_queries": {"type": "request_queries", "frame": 0, "bots": _BOTS[:1], "free": _FREE[:1]},
    "request_queries_all": {
        "type": "request_queries",
        "frame": 2**53,
        "bots": _BOTS,
        "free": _FREE,
        "rewards": [0.5, -1.0],
        "frame_budget_us": 25.0,
        "budgets_us": [20.0, 1e9],
        "target_costs_us": [0.25, 18.0],
        "deadline_us": 1e9,
    },
    "submit_features": {**_SUBMIT, "values": [[10.0, 1.0, 8.5, 9.5], [0.1]]},
    "submit_features_failed": {
        **_SUBMIT,
        "acquired": [[1, 0, 0, 0, 0, 0, 0, 0, 1, 0], [0] * 10],
        "values": [[10.0, 1.0, 8.5], []],
        "failed": [[0, 0, 0, 0, 0, 0, 0, 0, 0, 1], [0, 1, 0, 0, 0, 0, 0, 0, 0, 0]],
    },
    "submit_features_measured": {**_SUBMIT, "values": [[10.0, 1.0, 8.5, 9.5], [0.1]], "acquire_us": 40.5},
    "submit_features_hidden": {**_SUBMIT, "values": [[10.0, 1.0, 8.5, 9.5], [0.1]], "hidden": True},
    "take_turn": _TURN,
    "take_turn_all": {
        **_TURN,
        "failed": [[0] * 10, [0, 0, 1, 0, 0, 0, 0, 0, 0, 0]],
        "rewards": [0.5, -1.0],
        "acquire_us": 40.5,
        "frame_budget_us": 42.5,
        "budgets_us": [23.5, 19.0],
        "target_costs_us": [0.25, 18.0],
        "hidden": True,
        "deadline_us": 8000.0,
    },
    "take_turn_replayed": {**_TURN, "replayed_returns_to_go": [99.5, 0.1]},
    "submit_features_deadline": {**_SUBMIT, "values": [[10.0, 1.0, 8.5, 9.5], [0.1]], "deadline_us": 8000.0},
    "stop_bots": {"type": "stop_bots", "bots": _BOTS},
    "goodbye": {"type": "goodbye"},
}
_SERVED = {"bundle_version": 3, "bundle_sha256": "0123456789abcdef" * 4}
_NO_VERSION = {"bundle_version": None, "bundle_sha256": None}
_WELCOME = {
    "type": "welcome",
    "connection": "00112233445566778899aabbccddeeff",
    "bundle": "golden",
    "features": {"features": _FEATURES},
    "action": {"components": _ACTION},
    "cost_model": _COST_MODEL,
    "budget_us": 9.0,
    "context_length": 20,
    "max_bots": 256,
    "max_body_bytes": 65536,
    "target_cost_us": None,
    "cost_quantile": 0.998,
    **_SERVED,
    "replay_frames": 58,
    "target_return": 100.0,
    "deadline_us": None,
}
REPLIES: dict[str, dict[str, Any]] = {
    "welcome": _WELCOME,
    "welcome_no_context_target_cost": {
        **_WELCOME,
        "context_length": 1,
        "target_cost_us": 6.8,
        "cost_quantile": None,
        **_NO_VERSION,
        "replay_frames": 1,
        "deadline_us": 16000.0,
    },
    "bots_started": {"type": "bots_started", "bots": _BOTS, **_SERVED},
    "queries": {
        "type": "queries",
        "frame": 7,
        "queries": _QUERIES,
        "cost_us": [23.5, 17.5],
        "infer_us": 80.25,
        "reasons": None,
        "late": False,
    },
    "queries_shed": {
        "type": "queries",
        "frame": 7,
        "queries": [[0] * 10, [0] * 10],
        "cost_us": [0.0, 0.0],
        "infer_us": 0.0,
        "reasons": [7, 7],
        "late": True,
    },
    "actions_late": {
        "type": "actions",
        "frame": 7,
        "actions": [[-0.5, 1.0], [0.25, 0.0]],
        "reasons": [5, 12],
        "infer_us": 0.0,
        "turns": [8, 0],
        "hidden": None,
        "late": True,
    },
    "actions": {
        "type": "actions",
        "frame": 7,
        "actions": [[-0.5, 1.0], [0.25, 0.0]],
        "reasons": [0, 3],
        "infer_us": 120.0,
        "turns": [8, 0],
        "hidden": None,
        "late": False,
    },
    "actions_hidden": {
        "type": "actions",
        "frame": 7,
        "actions": [[-0.5, 1.0], [0.25, 0.0]],
        "reasons": [0, 1],
        "infer_us": 120.0,
        "turns": [8, 300],
        "hidden": [[1.5, -2.0, 0.25], [0.0, 8.0, -1.0]],
        "late": False,
    },
    "bots_stopped": {"type": "bots_stopped", "count": 2},
    "farewell": {"type": "farewell"},
    "error": {"type": "error", "code": "NO_BOT", "detail": "no bot 5 on this connection", "retry_after_s": None},
    "error_retry": {"type": "error", "code": "TOO_MANY_BOTS", "detail": "all 256 slots taken", "retry_after_s": 1.0},
}


def write_vectors(folder: Path) -> None:
    """Write every vector into `folder`; each frame is a 4-byte big-endian length and one msgpack body."""
    for direction, messages in (("request", REQUESTS), ("reply", REPLIES)):
        for name, message in messages.items():
            _write(folder, name, {"direction": direction, "message": message}, _pack(message))
    for name, (code, body) in _refused().items():
        _write(folder, f"refused_{name}", {"direction": "request", "refused_with": code}, body)


def _refused() -> dict[str, tuple[str, bytes]]:
    """Requests that a server of the golden `welcome` refuses, with the code that it refuses them with."""
    query, submit, turn = REQUESTS["request_queries_all"], REQUESTS["submit_features"], {**_TURN, "frame": 9}
    whole = _pack(query)
    return {
        "empty": ("BAD_MSGPACK", b""),
        "truncated": ("BAD_MSGPACK", whole[:-1]),
        "trailing": ("BAD_MSGPACK", whole + b"\xc0"),
        "reserved_byte": ("BAD_MSGPACK", b"\xc1"),
        "not_utf8": ("BAD_MSGPACK", b"\x81\xa4type\xa2\xff\xff"),
        "array_bomb": ("BAD_MSGPACK", b"\xdd\xff\xff\xff\xff"),
        "too_deep": ("TOO_DEEP", b"\x91" * 16384 + b"\xc0"),
        "bundle_name": ("BAD_SCHEMA", _pack({"type": "hello", "bundle": "../golden"})),
        "no_type": ("BAD_SCHEMA", _pack({"count": 1})),
        "unknown_type": ("BAD_SCHEMA", _pack({"type": "start_bot"})),
        "unknown_field": ("BAD_SCHEMA", _pack({"type": "start_bots", "count": 1, "colour": 2})),
        "missing_field": ("BAD_SCHEMA", _pack({"type": "start_bots"})),
        "wrong_type": ("BAD_SCHEMA", _pack({"type": "start_bots", "count": "1"})),
        "ext": ("BAD_SCHEMA", _pack({"type": "start_bots", "count": msgpack.ExtType(5, b"1")})),
        "negative_frame": ("BAD_SCHEMA", _pack({**query, "frame": -1})),
        "short_free": ("BAD_SHAPE", _pack({**query, "free": _FREE[:1]})),
        "bits_beyond_features": ("BAD_SHAPE", msgpack.packb({**_packable(submit), "acquired": b"\x01\xff\x02\x00"})),
        "values_do_not_match": ("BAD_SHAPE", _pack({**submit, "values": [[10.0], [0.1]]})),
        "nan": ("NON_FINITE", _pack({**query, "free": [[float("nan"), 0.0, 0.0], _FREE[1]]})),
        "infinite_reward": ("NON_FINITE", _pack({**query, "rewards": [0.0, float("inf")]})),
        "out_of_range": ("OUT_OF_RANGE", _pack({**query, "free": [[100.5, 0.0, 0.0], _FREE[1]]})),
        "value_out_of_range": ("OUT_OF_RANGE", _pack({**submit, "values": [[10.0, -1.0, 8.5, 9.5], [0.1]]})),
        "nan_acquire_us": ("NON_FINITE", _pack({**submit, "acquire_us": float("nan")})),
        "over_budget": ("OVER_BUDGET", _pack({**turn, "budgets_us": [1e9, 1.0]})),
        "over_frame_budget": ("OVER_BUDGET", _pack({**turn, "frame_budget_us": 8.5})),
        "nan_deadline_us": ("NON_FINITE", _pack({**query, "deadline_us": float("nan")})),
        "negative_deadline_us": ("OUT_OF_RANGE", _pack({**submit, "deadline_us": -1.0})),
        "negative_acquire_us": ("OUT_OF_RANGE", _pack({**submit, "acquire_us": -1.0})),
    }


def _packable(message: dict[str, Any]) -> dict[str, Any]:
    return {name: _blob(name, value) for name, value in message.items()}


def _pack(message: dict[str, Any]) -> bytes:
    return bytes(msgpack.packb(_packable(message)))


def _blob(name: str, value: Any) -> Any:
    if name in _FLOATS and isinstance(value, list):
        return b"".join(struct.pack(f"<{len(row)}f", *row) for row in value)
    if name in _BITS:
        return b"".join(np.packbits(np.array(row, dtype=bool), bitorder="little").tobytes() for row in value)
    return value


def _write(folder: Path, name: str, description: dict[str, Any], body: bytes) -> None:
    (folder / f"{name}.json").write_text(json.dumps(description, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    (folder / f"{name}.bin").write_bytes(struct.pack(">I", len(body)) + body)


if __name__ == "__main__":
    write_vectors(Path(__file__).parent)
