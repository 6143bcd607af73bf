"""What a server answers, as a client sees it: msgpack to dicts to small named tuples of numpy arrays.

This module knows nothing about sockets or requests. It reads with the `msgpack` package, never with `protocol.codec`:
see `protocol.client`. Whatever the bytes, it raises only ReplyError or the ProtocolError that the server sent.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgpack
import numpy as np
from numpy.typing import NDArray

from protocol.errors import ERRORS_BY_CODE, InternalError, ProtocolError
from protocol.features import ActionComponent, ActionSpec, CostModel, Feature, FeatureTable
from protocol.transport import ReplyError

__all__ = [
    "Actions",
    "Queries",
    "Welcome",
    "read_actions",
    "read_bots_started",
    "read_bots_stopped",
    "read_queries",
    "read_reply",
    "read_welcome",
]

_FLOAT, _BYTE, _BOOL = np.dtype("<f4"), np.dtype(np.uint8), np.dtype(np.bool_)
_MAX_ARRAY = 65536  # msgpack reserves memory for the length that an array claims, at every depth
_FAULTS = ValueError, KeyError, TypeError, AttributeError, OverflowError
_REPLY_TO = {
    "hello": "welcome",
    "start_bots": "bots_started",
    "request_queries": "queries",
    "submit_features": "actions",
    "take_turn": "actions",
    "stop_bots": "bots_stopped",
    "goodbye": "farewell",
}


class Welcome(NamedTuple):
    """What the server answers to hello: its bundle's features, action, costs and limits.

    `target_cost_us` is None where the bundle is not conditioned on its budget, and `cost_quantile` where the server
    takes no measurements; both from a server that is older than the field. `bundle_version` is None where the server
    keeps no versions; `bundle_sha256`, the hash of the manifest, only from an older server, as are `replay_frames` and
    `target_return`. `deadline_us` is None where requests have none unless they name it.
    """

    connection: str
    bundle: str
    features: FeatureTable
    action: ActionSpec
    cost_model: CostModel
    budget_us: float
    context_length: int
    max_bots: int
    max_body_bytes: int
    target_cost_us: float | None = None
    cost_quantile: float | None = None
    bundle_version: int | None = None
    bundle_sha256: str | None = None
    replay_frames: int | None = None
    target_return: float | None = None
    deadline_us: float | None = None


class Queries(NamedTuple):
    """Which costly features to acquire: `queries` bool [N, M], `cost_us` float64 [N] predicted, `infer_us` spent.

    `reasons` uint8 [N]: why a bot asks for nothing, 0 where that is learned. `late`: it left after its deadline,
    or came after it by the client's own clock.
    """

    frame: int
    queries: NDArray[np.bool_]
    cost_us: NDArray[np.float64]
    infer_us: float
    reasons: NDArray[np.uint8]
    late: bool = False


class Actions(NamedTuple):
    """What to do: `actions` float32 [N, A]; `reasons` uint8 [N], 0 = learned; `infer_us` spent; `late` as in Queries.

    `turns` int64 [N] is how many each context took, None from an older server; `hidden` float32 [N, W] if asked for.
    """

    frame: int
    actions: NDArray[np.float32]
    reasons: NDArray[np.uint8]
    infer_us: float
    turns: NDArray[np.int64] | None = None
    hidden: NDArray[np.float32] | None = None
    late: bool = False


def read_reply(body: bytes, request_type: str) -> dict[str, Any]:
    """The reply's fields; raises the ProtocolError that an `error` message names, ReplyError if this is no answer."""
    try:
        reply: dict[str, Any] = msgpack.unpackb(body, max_array_len=min(_MAX_ARRAY, len(body)))
        kind = reply["type"]  # what is no map has no field of this name either
    except _FAULTS as error:
        raise _unreadable(request_type, error) from error
    if kind == "error":
        raise _refused(reply)
    if kind != _REPLY_TO[request_type]:
        raise ReplyError(f"the reply to {request_type} is {kind!r}, expected {_REPLY_TO[request_type]!r}")
    return reply


def read_welcome(reply: dict[str, Any]) -> Welcome:
    """The fields of a `welcome`; raises ReplyError."""
    try:
        replay_frames = reply.get("replay_frames")
        return Welcome(
            connection=str(reply["connection"]),
            bundle=str(reply["bundle"]),
            features=FeatureTable(tuple(Feature(**_known(Feature, each)) for each in reply["features"]["features"])),
            action=ActionSpec(
                tuple(ActionComponent(**_known(ActionComponent, each)) for each in reply["action"]["components"])
            ),
            cost_model=CostModel(reply["cost_model"]["call_us"], tuple(reply["cost_model"]["feature_us"])),
            budget_us=float(reply["budget_us"]),
            context_length=int(reply["context_length"]),
            max_bots=int(reply["max_bots"]),
            max_body_bytes=int(reply["max_body_bytes"]),
            target_cost_us=_float(reply.get("target_cost_us")),
            cost_quantile=_float(reply.get("cost_quantile")),
            **_read_version(reply),
            replay_frames=None if replay_frames is None else int(replay_frames),
            target_return=_float(reply.get("target_return")),
            deadline_us=_float(reply.get("deadline_us")),
        )
    except _FAULTS as error:
        raise _unreadable("hello", error) from error


def _float(number: Any) -> float | None:
    return None if number is None else float(number)


def read_bots_started(reply: dict[str, Any], welcome: Welcome, count: int) -> tuple[NDArray[np.int64], Welcome]:
    """The handles of a `bots_started` for so many, and `welcome` with the version that these bots are of; raises
    ReplyError."""
    try:
        return np.array(reply["bots"], dtype=np.int64).reshape(count), welcome._replace(**_read_version(reply))
    except _FAULTS as error:
        raise _unreadable("start_bots", error) from error


def read_bots_stopped(reply: dict[str, Any]) -> int:
    """How many ended; raises ReplyError."""
    try:
        return int(reply["count"])
    except _FAULTS as error:
        raise _unreadable("stop_bots", error) from error


def read_queries(reply: dict[str, Any], bots: int, table: FeatureTable) -> Queries:
    """The fields of a `queries` for N = `bots`; raises ReplyError."""
    try:
        bytes_NB = np.frombuffer(reply["queries"], _BYTE).reshape(bots, -(-table.n_queries // 8))
        queries_NM = np.unpackbits(bytes_NB, 1, table.n_queries, "little").view(_BOOL)
        cost_us_N = np.array(reply["cost_us"], np.float64).reshape(bots)
        reasons = reply.get("reasons")
        reasons_N = _reasons(reasons, bots) if reasons else np.zeros(bots, _BYTE)
        infer_us, late = float(reply["infer_us"]), bool(reply.get("late"))
        return Queries(int(reply["frame"]), queries_NM, cost_us_N, infer_us, reasons_N, late)
    except _FAULTS as error:
        raise _unreadable("request_queries", error) from error


def read_actions(reply: dict[str, Any], bots: int, action: ActionSpec) -> Actions:
    """The fields of an `actions` for N = `bots`; raises ReplyError."""
    try:
        actions_NA = np.frombuffer(reply["actions"], _FLOAT).reshape(bots, action.size)
        reasons_N = _reasons(reply["reasons"], bots)
        infer_us, late = float(reply["infer_us"]), bool(reply.get("late"))
        turns, hidden = reply.get("turns"), reply.get("hidden")
        turns_N = None if turns is None else np.array(turns, np.int64).reshape(bots)
        hidden_NW = None if hidden is None else np.frombuffer(hidden, _FLOAT).reshape(bots, -1)
        return Actions(int(reply["frame"]), actions_NA, reasons_N, infer_us, turns_N, hidden_NW, late)
    except _FAULTS as error:
        raise _unreadable("submit_features", error) from error


def _reasons(reasons: list[int], bots: int) -> NDArray[np.uint8]:
    return np.array(reasons, _BYTE).reshape(bots)


def _read_version(reply: dict[str, Any]) -> dict[str, Any]:
    version, sha256 = reply.get("bundle_version"), reply.get("bundle_sha256")
    return {
        "bundle_version": None if version is None else int(version),
        "bundle_sha256": None if sha256 is None else str(sha256),
    }


def _known(kind: type[Feature | ActionComponent], fields: dict[str, Any]) -> dict[str, Any]:
    """A newer server may say more than this client knows."""
    return {name: fields[name] for name in kind.__struct_fields__}


def _unreadable(request_type: str, error: Exception) -> ReplyError:
    return ReplyError(f"the reply to {request_type} is not what the protocol says: {error!r}")


def _refused(reply: dict[str, Any]) -> ProtocolError:
    code, detail = str(reply.get("code")), str(reply.get("detail"))
    refusal = ERRORS_BY_CODE.get(code)
    if refusal is None:  # the code of a newer server
        return InternalError(f"{code}: {detail}")
    return refusal(detail, retry_after_s=reply.get("retry_after_s"))
