"""A server in memory and its model, side by side, for one run of the state machine after the other.

This module knows nothing about which requests are sent.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgpack

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.codec import Format
from protocol.errors import ProtocolError
from server.answer import Arrival, answer
from server.connections import Connections
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from tests.fuzz.model import MAX_BOTS, MAX_CONNECTIONS, TTL_S, Model

__all__ = ["World"]


class World:
    """The server and the model, made once for all runs: what a run leaves behind is ended before the next."""

    def __init__(self, bundle: Bundle) -> None:
        self._bundle = bundle
        self.used: set[int] = set()
        self.replies = Counter[str]()
        self._make()

    def _make(self) -> None:
        self.model, self.now_s = Model(self._bundle), 0.0
        serving, servings = Serving(self._bundle, max_bots=MAX_BOTS), Servings(max_bots=MAX_BOTS)
        serving.bots = self.bots = Bots(self._bundle, max_bots=MAX_BOTS, clock=lambda: 0)
        servings.activate(serving)
        self.connections = Connections(MAX_CONNECTIONS, TTL_S, lambda: self.now_s)
        self.handlers = Handlers(servings, self.connections, None)

    def clear(self) -> None:
        """End everything; begin anew where a divergence has left something."""
        try:
            for connection in list(self.connections):
                self.handlers.end(connection.id)
            self.model.clear()
        except (ProtocolError, LookupError):
            self._make()
        if (self.bots.n_bots, len(self.connections)) != (0, 0):
            self._make()

    def wait(self, seconds: float) -> None:
        """Nothing happens for so long."""
        self.now_s += seconds
        self.model.now_s = self.now_s

    def send(self, connection: str | None, **message: Any) -> dict[str, Any]:
        """The reply to a message, as an engine would read it."""
        body = msgpack.packb(message)
        answered = answer(self.handlers, body, Format.MSGPACK, connection, Arrival.now("tcp"))
        reply = dict(msgpack.unpackb(answered.body))
        self.replies[reply.get("code", reply["type"])] += 1
        return reply
