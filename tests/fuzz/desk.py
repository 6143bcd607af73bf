"""Handlers in memory, twice: one that is sent everything, and a twin that is sent only what the first accepted.

As long as a refused request changes nothing, the two answer every accepted one with the same bytes. This module knows
nothing about where requests come from.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgpack
import msgspec
import numpy as np

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.codec import Format
from protocol.errors import ERRORS_BY_CODE
from protocol.messages import Error, Reply, Request, Welcome
from protocol.replies import read_queries
from server.answer import Answer, Arrival, answer
from server.connections import Connections
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from tests.server.serving import costly_numbers, free_numbers

__all__ = ["PENDING_FRAME", "UNDOCUMENTED", "Desk", "Exchange", "Twins"]

MAX_BOTS = 6
PENDING_FRAME = 7
_SEEDS = [1, 2]
_REPLY = {Format.MSGPACK: msgspec.msgpack.Decoder(Reply), Format.JSON: msgspec.json.Decoder(Reply)}
# Codes that these requests must never get: the server's own failures, and what only doors or bundles say.
UNDOCUMENTED = {"INTERNAL", "NO_ROUTE", "METHOD_NOT_ALLOWED", "UNSUPPORTED_MEDIA_TYPE", "TOO_LARGE", "BAD_BUNDLE"}


class Exchange(NamedTuple):
    """One request: bytes, format, the message type where the door fixes it, and whether it names the connection."""

    body: bytes
    form: Format
    kind: type[Request] | None
    connected: bool


class Desk:
    """Handlers with one connection and two bots, which have played a frame and wait for the features of another."""

    def __init__(self, bundle: Bundle) -> None:
        serving, servings = Serving(bundle, max_bots=MAX_BOTS), Servings(max_bots=MAX_BOTS)
        serving.bots = self.bots = Bots(bundle, max_bots=MAX_BOTS, clock=lambda: 0, first_generation=1)
        servings.activate(serving)
        self.table = bundle.manifest.features
        # More than are ever open at once: those that are refused close nothing.
        self._handlers = Handlers(servings, Connections(4, 1e9), None)
        self._connection: str | None = None
        self.handles: list[int] = []

    def open(self) -> None:
        """End the connection, if there is one, and begin anew."""
        if self._connection is not None:
            self._handlers.end(self._connection)
        self._connection = None
        self._connection = self._told({"type": "hello"})["connection"]
        self.handles = self._told({"type": "start_bots", "count": 2, "seeds": _SEEDS})["bots"]
        query_NM = self.query(PENDING_FRAME - 4)
        self._told(self.submission(PENDING_FRAME - 4, query_NM))
        self.pending_NM = self.query(PENDING_FRAME)

    def query(self, frame: int) -> np.ndarray:
        """Ask for all bots; returns the queries."""
        return read_queries(self._told(self.request(frame)), 2, self.table).queries

    def request(self, frame: int) -> dict[str, Any]:
        """The message that asks for all bots; its numbers depend on the frame alone."""
        free = free_numbers(self.table, 2, frame).tobytes()
        return {"type": "request_queries", "frame": frame, "bots": self.handles, "free": free}

    def submission(self, frame: int, query_NM: np.ndarray) -> dict[str, Any]:
        """The message that answers this query."""
        values = costly_numbers(self.table, 2, frame)[query_NM[:, self.table.owner]]
        message = {"type": "submit_features", "frame": frame, "bots": self.handles, "values": values.tobytes()}
        return message | {"acquired": np.packbits(query_NM, axis=1, bitorder="little").tobytes()}

    def ask(self, exchange: Exchange) -> Answer:
        """The answer that a door would send."""
        connection = self._connection if exchange.connected else None
        return answer(self._handlers, exchange.body, exchange.form, connection, Arrival.now("tcp"), kind=exchange.kind)

    def forget(self, welcome: Welcome) -> None:
        """End a connection that a request opened."""
        self._handlers.end(welcome.connection)

    def _told(self, message: dict[str, Any]) -> dict[str, Any]:
        reply = msgpack.unpackb(self.ask(Exchange(msgpack.packb(message), Format.MSGPACK, None, True)).body)
        assert reply["type"] != "error", reply
        return reply


class Twins:
    """Two desks that must never differ."""

    def __init__(self, bundle: Bundle) -> None:
        self.fuzzed, self._clean = Desk(bundle), Desk(bundle)
        self.open()

    def open(self) -> None:
        """Both begin anew, with bots of the same names."""
        self.fuzzed.open()
        self._clean.open()
        assert self.fuzzed.handles == self._clean.handles, "a refused request used up names of bots"

    def ask(self, exchange: Exchange) -> str:
        """Send a request; the code or type of its answer. Raises AssertionError for one that is not documented."""
        answered = self.fuzzed.ask(exchange)
        reply = _REPLY[exchange.form].decode(answered.body)
        if isinstance(reply, Error):
            assert reply.code not in UNDOCUMENTED, reply
            assert ERRORS_BY_CODE[reply.code].status == answered.status, reply
            return reply.code
        assert answered.status == 200
        accepted = self._clean.ask(exchange)
        if isinstance(reply, Welcome):
            self.fuzzed.forget(reply)
            self._clean.forget(accepted.reply)
        else:
            assert answered.body == accepted.body, f"a refused request changed {type(reply).__name__}"
        return type(reply).__struct_config__.tag

    def compare(self, frames: int) -> None:
        """The bots' next frames, on both desks, whatever came before: the answers are the same bytes."""
        desk = self.fuzzed
        for frame in (*range(PENDING_FRAME + 1, PENDING_FRAME + frames), 2**53):
            reply = self._both(desk.request(frame))
            if reply["type"] == "queries":
                self._both(desk.submission(frame, read_queries(reply, 2, desk.table).queries))
        assert desk.bots.n_bots == self._clean.bots.n_bots

    def _both(self, message: dict[str, Any]) -> dict[str, Any]:
        exchange = Exchange(msgpack.packb(message), Format.MSGPACK, None, True)
        fuzzed, clean = self.fuzzed.ask(exchange).body, self._clean.ask(exchange).body
        assert fuzzed == clean, f"after refused requests: {fuzzed!r}, without them: {clean!r}"
        return msgpack.unpackb(fuzzed)
