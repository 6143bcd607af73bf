"""The messages: exactly one reply a request, N bots a message.

This module knows nothing about bytes on a wire, arrays or turn order. A msgspec struct's tag travels as the field
`type`; unknown fields are refused; a field added later gets a default. Shape letters as in `protocol.features`.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta, Struct

from protocol.features import ActionSpec, CostModel, FeatureTable

__all__ = [
    "MAX_BOTS_PER_MESSAGE",
    "MAX_DEADLINE_US",
    "MAX_FRAME",
    "MAX_RETURN",
    "MAX_RETURN_TO_GO",
    "PROTOCOL_VERSION",
    "Actions",
    "Bits",
    "Blob",
    "BotsStarted",
    "BotsStopped",
    "Error",
    "Farewell",
    "Goodbye",
    "Hello",
    "Queries",
    "Reply",
    "Request",
    "RequestQueries",
    "StartBots",
    "StopBots",
    "SubmitFeatures",
    "TakeTurn",
    "Welcome",
]

PROTOCOL_VERSION = 1
MAX_BOTS_PER_MESSAGE = 65536
MAX_FRAME = 2**53  # the largest count that a JSON number or a double holds exactly
MAX_DEADLINE_US = 1e9
MAX_RETURN = 1e9  # of one reward or target return: float32 holds sums of very many
MAX_RETURN_TO_GO = 1e30  # what no sum of them reaches, and float32 holds

Blob = bytes | Annotated[list[list[float]], Meta(max_length=MAX_BOTS_PER_MESSAGE)]
"""float32 [N, n]: little-endian row-major bytes in msgpack, nested lists in JSON."""
Bits = bytes | Annotated[list[list[Annotated[int, Meta(ge=0, le=1)]]], Meta(max_length=MAX_BOTS_PER_MESSAGE)]
"""bool [N, M]: ceil(M / 8) bytes a row, feature i is bit i % 8 of byte i // 8; rows of 0/1 in JSON."""

_Frame = Annotated[int, Meta(ge=0, le=MAX_FRAME)]
_Count = Annotated[int, Meta(ge=1, le=MAX_BOTS_PER_MESSAGE)]
_Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Handle = Annotated[int, Meta(ge=0, le=2**63 - 1)]
_Handles = Annotated[list[_Handle], Meta(min_length=1, max_length=MAX_BOTS_PER_MESSAGE)]
_Turns = Annotated[list[_Frame], Meta(max_length=MAX_BOTS_PER_MESSAGE)]
_PerBot = Annotated[list[float], Meta(max_length=MAX_BOTS_PER_MESSAGE)]
_Token = Annotated[str, Meta(max_length=1024)]
_BundleName = Annotated[str, Meta(pattern="^[a-z0-9][a-z0-9_-]{0,63}(@[1-9][0-9]{0,8})?$", max_length=74)]
_Version = Annotated[int, Meta(ge=1)]


class _Message(Struct, frozen=True, forbid_unknown_fields=True, tag_field="type"):
    pass


class Hello(_Message, frozen=True, tag="hello"):
    """Open a connection. `cost_model` is the engine's own measurement; without it the bundle's declared costs count.

    `bundle` is the name of what to be served, `NAME@VERSION` for that version alone; null where there is only one.
    """

    protocol: int = PROTOCOL_VERSION
    cost_model: CostModel | None = None
    token: _Token | None = None
    bundle: _BundleName | None = None


class Welcome(_Message, frozen=True, tag="welcome"):
    """The connection's name, what is served, what it costs and every limit.

    `budget_us` is a bot's default budget, `target_cost_us` its default target cost, null where the bundle has none.
    `cost_quantile` is how often acquiring is to take no longer than predicted, once it is measured; null where a
    server takes no measurements. `bundle_version` is null where the server has no store of versions; `bundle_sha256` is
    of the bundle's manifest, which has the hashes of its other files. `deadline_us` is what counts for requests that
    name none, if anything.
    `replay_frames` is how many of a bot's last turns rebuild its context, `target_return` a bot's target return unless
    told otherwise; null from a server that knows no `take_turn`.
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
    bundle_version: _Version | None = None
    bundle_sha256: str | None = None
    replay_frames: int | None = None
    target_return: float | None = None
    deadline_us: float | None = None


class StartBots(_Message, frozen=True, tag="start_bots"):
    """Start `count` bots; each list, where given, has one entry a bot.

    `turns` are those that a bot took before, at a server that is gone: it goes on with the next one's noise.
    """

    count: _Count
    seeds: Annotated[list[_Seed], Meta(max_length=MAX_BOTS_PER_MESSAGE)] | None = None
    target_returns: _PerBot | None = None
    budgets_us: _PerBot | None = None
    target_costs_us: _PerBot | None = None
    turns: _Turns | None = None


class BotsStarted(_Message, frozen=True, tag="bots_started"):
    """Opaque 63-bit handles, in the order of the request, and what these bots are of, as in Welcome."""

    bots: list[_Handle]
    bundle_version: _Version | None = None
    bundle_sha256: str | None = None


class RequestQueries(_Message, frozen=True, tag="request_queries"):
    """Ask which costly features to acquire. `free` is [N, F]; `rewards` [N] came since each bot's last frame.

    `frame_budget_us` is shared by all bots of the message, on top of each bot's own budget. `budgets_us` and
    `target_costs_us` [N] replace those of the bots' start for this frame only. `deadline_us` is how long after the
    server has received the whole request its answer must leave.
    """

    frame: _Frame
    bots: _Handles
    free: Blob
    rewards: _PerBot | None = None
    frame_budget_us: float | None = None
    budgets_us: _PerBot | None = None
    target_costs_us: _PerBot | None = None
    deadline_us: float | None = None


class Queries(_Message, frozen=True, tag="queries"):
    """The queries, bits [N, M], their predicted cost [N] in µs and the time spent deciding, in µs.

    `reasons` [N] says why a bot asks for nothing where that was not decided (0 = it was); null: all were. `late`: this
    reply leaves after its deadline all the same.
    """

    frame: _Frame
    queries: Bits
    cost_us: list[float]
    infer_us: float
    reasons: list[int] | None = None
    late: bool = False


class SubmitFeatures(_Message, frozen=True, tag="submit_features"):
    """What was acquired for the pending queries of the same bots in the same order.

    `acquired` and `failed` are bits [N, M]. `values` is ragged: for each bot in order, for each acquired feature in
    order, its `size` numbers (float32 little-endian bytes, or one list a bot). `acquire_us` is what acquiring all of
    this took, as the engine measured it. `hidden` asks for each bot's hidden state in the reply. `deadline_us` is as in
    RequestQueries.
    """

    frame: _Frame
    bots: _Handles
    acquired: Bits
    values: Blob
    failed: Bits | None = None
    acquire_us: float | None = None
    hidden: bool = False
    deadline_us: float | None = None


class TakeTurn(_Message, frozen=True, tag="take_turn"):
    """A whole turn in one message, where the engine has decided what to acquire: the fields of both halves.

    What was acquired or failed is the query, and must fit the budgets. `replayed_returns_to_go` [N] says that the turn
    was taken before, at a server that is gone, and what each bot had left in it, its rewards counted: no budget is
    checked, and what the bot itself has left stays.
    """

    frame: _Frame
    bots: _Handles
    free: Blob
    acquired: Bits
    values: Blob
    rewards: _PerBot | None = None
    failed: Bits | None = None
    acquire_us: float | None = None
    frame_budget_us: float | None = None
    budgets_us: _PerBot | None = None
    target_costs_us: _PerBot | None = None
    hidden: bool = False
    replayed_returns_to_go: _PerBot | None = None
    deadline_us: float | None = None


class Actions(_Message, frozen=True, tag="actions"):
    """The actions [N, A]; why each bot got its action (0 = learned) [N]; the time spent deciding, in µs.

    `turns` [N] says how many turns each bot's context has taken; `hidden` [N, W] is its state after them, if asked for.
    `late`: this reply leaves after its deadline all the same.
    """

    frame: _Frame
    actions: Blob
    reasons: list[int]
    infer_us: float
    turns: list[int] | None = None
    hidden: Blob | None = None
    late: bool = False


class StopBots(_Message, frozen=True, tag="stop_bots"):
    """End these bots; their handles are never used again."""

    bots: _Handles


class BotsStopped(_Message, frozen=True, tag="bots_stopped"):
    """How many bots ended."""

    count: int


class Goodbye(_Message, frozen=True, tag="goodbye"):
    """End the connection and its bots."""


class Farewell(_Message, frozen=True, tag="farewell"):
    """The connection has ended."""


class Error(_Message, frozen=True, tag="error"):
    """The request was refused and changed nothing. `code` is one of `protocol.errors`."""

    code: str
    detail: str
    retry_after_s: float | None = None


Request = Hello | StartBots | RequestQueries | SubmitFeatures | TakeTurn | StopBots | Goodbye
Reply = Welcome | BotsStarted | Queries | Actions | BotsStopped | Farewell | Error
