"""Connections: who is there, which bots are theirs, and since when they have been silent.

This module knows nothing about transports, messages or what a bot is beyond its handle.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bot_runtime.costs import Costs
from protocol.errors import NoBot, NoConnection, TooManyConnections
from protocol.features import CostModel
from server.serving import Serving

__all__ = ["Connection", "Connections"]


@dataclass(eq=False)
class Connection:
    """One engine's link to the server; it alone may name its bots, which are bots of `serving`.

    `costs` are as it declared, then as it measures. `is_pinned` where the engine named the very version: no other will
    do. `asked` is the last query that it was sent, as its reply has it and as bool [N, M]. `answered_ns` is when its
    last turn was answered, by the desk's clock.
    """

    id: str
    serving: Serving
    costs: Costs
    last_seen_s: float
    is_pinned: bool = False
    bots: set[int] = field(default_factory=set)
    asked: tuple[object, NDArray[np.bool_]] | None = None
    answered_ns: int = 0

    @property
    def measured_costs(self) -> Costs | None:
        """None as long as nothing was measured: the costs are then those of the bots' start, which are at hand."""
        return self.costs if self.costs.n_frames else None

    def query_of(self, packed: object, n_bots: int) -> NDArray[np.bool_] | None:
        """The last query of so many bots if this is it: what is acquired mostly is, and need not be read again."""
        if self.asked is None or len(self.asked[1]) != n_bots or self.asked[0] != packed:
            return None
        return self.asked[1]

    def check_owns(self, handles: Sequence[int]) -> None:
        """Raise NoBot for a bot that is not this connection's."""
        if not self.bots.issuperset(handles):
            unknown = next(handle for handle in handles if handle not in self.bots)
            raise NoBot(f"no bot {unknown} on this connection")


class Connections:
    """Every open connection, by its unguessable name. `clock` is monotonic, in seconds.

    Names begin with `process` and a hyphen where there is one, so that a front knows which of several processes holds a
    connection.
    """

    def __init__(
        self,
        max_connections: int,
        idle_ttl_s: float,
        clock: Callable[[], float] = time.monotonic,
        *,
        process: str | None = None,
    ) -> None:
        self._by_id: dict[str, Connection] = {}
        self._prefix = "" if process is None else f"{process}-"
        self._max_connections = max_connections
        self._idle_ttl_s = idle_ttl_s
        self._clock = clock

    def __len__(self) -> int:
        return len(self._by_id)

    def __iter__(self) -> Iterator[Connection]:
        return iter(self._by_id.values())

    def open(self, cost_model: CostModel, serving: Serving, *, is_pinned: bool = False) -> Connection:
        """A new connection to bots of `serving`; raises TooManyConnections."""
        if len(self._by_id) >= self._max_connections:
            raise TooManyConnections(f"all {self._max_connections} connections are taken", retry_after_s=1.0)
        name = self._prefix + secrets.token_hex(16)
        connection = Connection(name, serving, Costs(cost_model), self._clock(), is_pinned)
        self._by_id[connection.id] = connection
        return connection

    def get(self, connection_id: str | None) -> Connection:
        """The connection of this name; raises NoConnection, also if it is overdue."""
        connection = self.heard(connection_id)
        if connection is None:
            raise NoConnection("say hello first" if connection_id is None else "no such connection: say hello again")
        return connection

    def heard(self, connection_id: str | None) -> Connection | None:
        """The connection of this name, of which a request has come, whatever becomes of it; None where there is none,
        or it was silent for too long before."""
        connection, now_s = self.peek(connection_id), self._clock()
        if connection is None or self._is_silent(connection, now_s):
            return None
        connection.last_seen_s = now_s
        return connection

    def peek(self, connection_id: str | None) -> Connection | None:
        """The connection of this name if there is one, which is not thereby heard from; from any thread."""
        return self._by_id.get(connection_id) if connection_id is not None else None

    def remove(self, connection_id: str) -> Connection | None:
        """Forget a connection, and return it if there was one."""
        return self._by_id.pop(connection_id, None)

    def silent(self) -> list[Connection]:
        """Every connection that has been silent for longer than the TTL."""
        now_s = self._clock()
        return [each for each in self._by_id.values() if self._is_silent(each, now_s)]

    def _is_silent(self, connection: Connection, now_s: float) -> bool:
        return now_s - connection.last_seen_s > self._idle_ttl_s
