"""What a server must answer: a model of connections, ownership and turn order that keeps everything in dicts and lists.

It says which errors a request may get; what it accepts goes to bots of its own, which see neither connections nor
refused requests nor retries, and their answers must be the server's. This module knows nothing about the server.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol import arrays
from protocol.codec import Format

__all__ = ["MAX_BOTS", "MAX_CONNECTIONS", "TTL_S", "Model"]

MAX_BOTS, MAX_CONNECTIONS, TTL_S = 5, 3, 10.0
Reply = dict[str, Any]


@dataclass
class Frame:
    """The last turn of some bots: what began it, what was answered, and what ended it."""

    number: int
    bots: list[int]
    taken: bool  # in one message
    content: tuple[Any, ...]
    query_NM: np.ndarray
    reply: Reply
    submitted: bytes | None = None
    done: Reply | None = None


@dataclass
class Link:
    """A connection."""

    seen_s: float
    bots: set[int] = field(default_factory=set)


class Model:
    """Every method says what the server must reply, or which codes it may refuse with; those change nothing here."""

    def __init__(self, bundle: Bundle) -> None:
        self._oracle = Bots(bundle, max_bots=MAX_BOTS, clock=lambda: 0, first_generation=1)
        self.table = bundle.manifest.features
        self.now_s = 0.0
        self.links: dict[str, Link] = {}
        self.last: dict[int, Frame | None] = {}
        self._own: dict[int, int] = {}  # names of the oracle's bots

    def clear(self) -> None:
        """End everything."""
        for name in list(self.links):
            self.end(name)

    def sweep(self) -> None:
        """End what has been silent for too long."""
        for name in [name for name, link in self.links.items() if self.now_s - link.seen_s > TTL_S]:
            self.end(name)

    def may_open(self) -> set[str]:
        """A hello also sweeps."""
        self.sweep()
        return {"TOO_MANY_CONNECTIONS"} if len(self.links) >= MAX_CONNECTIONS else set()

    def open(self, name: str) -> None:
        """The server gave a connection this name, which nobody had before."""
        self.links[name] = Link(self.now_s)

    def hear(self, name: str) -> set[str]:
        """A connection says something."""
        link = self.links.get(name)
        if link is None or self.now_s - link.seen_s > TTL_S:
            return {"NO_CONNECTION"}
        link.seen_s = self.now_s
        return set()

    def may_start(self, count: int) -> set[str]:
        """Bots of silent connections count until they are swept."""
        return {"TOO_MANY_BOTS"} if len(self.last) + count > MAX_BOTS else set()

    def start(self, name: str, bots: list[int], seeds: list[int], budgets_us: list[float]) -> None:
        """The server gave them these names, which nobody had before."""
        self.links[name].bots.update(bots)
        own = self._oracle.start(len(bots), seeds=seeds, budgets_us=budgets_us).tolist()
        self._own.update(zip(bots, own, strict=True))
        self.last.update(dict.fromkeys(bots))

    def stop(self, name: str, bots: list[int]) -> None:
        """They are gone."""
        if bots:
            self._oracle.stop(self._names(bots))
        self.links[name].bots.difference_update(bots)
        for bot in bots:
            del self.last[bot], self._own[bot]

    def end(self, name: str) -> None:
        """A connection is gone, and its bots."""
        self.stop(name, sorted(self.links[name].bots))
        del self.links[name]

    def owned(self, name: str, bots: list[int]) -> set[str]:
        """A connection may name its own bots."""
        return set() if self.links[name].bots.issuperset(bots) else {"NO_BOT"}

    def may_begin(self, bots: list[int], number: int, taken: bool) -> set[str]:
        """What turn order has against a query, or a whole turn, of this frame."""
        frames = [self.last[bot] for bot in bots]
        refused = {"STALE_FRAME" for frame in frames if frame is not None and number < frame.number}
        same = [frame for frame in frames if frame is not None and number == frame.number]
        if taken and any(frame.done is None for frame in same):
            refused.add("FRAME_REUSED")
        if refused or not same:
            return refused
        whole = frames[0] is not None and frames[0].bots == bots and all(frame is frames[0] for frame in frames)
        return set() if whole and same[0].taken is taken else {"FRAME_REUSED"}

    def begun(self, bots: list[int], number: int, content: tuple[Any, ...]) -> Reply | set[str] | None:
        """The answer to a retry; None where this is a new frame."""
        frame = self.last[bots[0]]
        if frame is None or frame.number != number:
            return None
        if frame.content != content:
            return {"FRAME_REUSED"}
        return frame.done if frame.taken else frame.reply

    def ask(self, bots: list[int], number: int, free_NF: np.ndarray, rewards: list[float], content: Any) -> Reply:
        """The answer to a new query."""
        queries = self._oracle.request_queries(self._names(bots), number, free_NF, rewards)
        packed = arrays.pack_bits(queries.query_NM, Format.MSGPACK)
        reply = {"type": "queries", "frame": number, "queries": packed, "cost_us": queries.cost_us_N.tolist()}
        self._begin(Frame(number, bots, False, content, queries.query_NM, reply))
        return reply

    def take(self, bots: list[int], number: int, free_NF: np.ndarray, rewards: list[float], content: Any) -> Reply:
        """The answer to a new turn, in which nothing was acquired."""
        none_NM = np.zeros((len(bots), self.table.n_queries), dtype=np.bool_)
        costly_ND = np.zeros((len(bots), self.table.n_costly), dtype=np.float32)
        actions = self._oracle.take_turn(self._names(bots), number, free_NF, none_NM, costly_ND, None, rewards)
        reply = _actions(number, actions.action_NA, actions.reasons_N)
        self._begin(Frame(number, bots, True, content, none_NM, reply, done=reply))
        return reply

    def may_submit(self, bots: list[int], number: int) -> set[str]:
        """What turn order has against the features of this frame."""
        frames, refused = [self.last[bot] for bot in bots], set()
        for frame in frames:
            if frame is None or number > frame.number:
                refused.add("NO_PENDING_QUERY")
            elif number < frame.number:
                refused.add("STALE_FRAME")
        if refused:
            return refused
        if frames[0].bots != bots or any(frame is not frames[0] for frame in frames):
            return {"NO_PENDING_QUERY"}
        return {"FRAME_REUSED"} if frames[0].taken else set()

    def submit(self, bots: list[int], costly_ND: np.ndarray) -> Reply | set[str]:
        """The answer to all that was asked for; the same again to a retry."""
        frame = self.last[bots[0]]
        values = costly_ND[frame.query_NM[:, self.table.owner]].tobytes()
        if frame.done is None:
            handles, query_NM = self._names(bots), frame.query_NM
            actions = self._oracle.submit_features(handles, frame.number, query_NM, costly_ND)
            frame.submitted, frame.done = values, _actions(frame.number, actions.action_NA, actions.reasons_N)
        return frame.done if frame.submitted == values else {"FRAME_REUSED"}

    def _begin(self, frame: Frame) -> None:
        self.last.update(dict.fromkeys(frame.bots, frame))

    def _names(self, bots: list[int]) -> np.ndarray:
        return np.array([self._own[bot] for bot in bots], dtype=np.int64)


def _actions(number: int, action_NA: np.ndarray, reasons_N: np.ndarray) -> Reply:
    packed = arrays.pack_floats(action_NA, Format.MSGPACK)
    return {"type": "actions", "frame": number, "actions": packed, "reasons": reasons_N.tolist()}
