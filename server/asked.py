"""A request at the desk, and which of those that wait are answered together.

This module knows nothing about sockets, about what an answer says, or about where it is given.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping

from msgspec import Struct

from bot_runtime.together import MAX_BOTS_EACH
from bot_runtime.work import Steps
from protocol.codec import Format
from server.answer import Answer, Arrival
from server.connections import Connection
from server.pace import Kind, Pace
from server.serving import Serving

__all__ = ["Asked", "Line", "companions"]


class Asked(Struct, frozen=True):  # made anew for every request: see Arrival
    """How a request is answered, and by what it is known how long that takes.

    `turn` is what its pace goes by, None where it never stays on the event loop; `kind` and `size` what its whole does.
    `connection` is the one that `connection_id` names, if there is one.
    """

    steps: Callable[[], Steps[Answer]]
    arrival: Arrival
    form: Format
    connection_id: str | None
    pace: Pace
    kind: type[object]
    size: int
    turn: Kind | None = None
    connection: Connection | None = None

    @property
    def serving(self) -> Serving | None:
        """What its connection holds."""
        return None if self.connection is None else self.connection.serving

    @property
    def work_us(self) -> float:
        """What it is expected to take; 0 where nothing is known."""
        return self.pace.whole_us(self.kind, self.size)

    def may_join(self, other: Asked) -> bool:
        """Whether both can be inferred as one batch, and that is quicker."""
        served_alike = self.serving is not None and self.serving is other.serving
        return served_alike and self.turn is not None and 0 < self.size <= MAX_BOTS_EACH


Line = Mapping[asyncio.Future[Answer], Asked]
"""What waits, in its order, and whose answer it will be."""


def companions(
    first: Asked, line: Line, most: int, is_quick: Callable[[Asked], bool]
) -> list[tuple[asyncio.Future[Answer], Asked]]:
    """What is answered together with a turn that is quick, itself not counted: fewer than `most`, one of a connection.

    None overtakes another request of its own connection.
    """
    known, found = {first.connection_id}, list[tuple[asyncio.Future[Answer], Asked]]()
    if not (most > 1 and first.may_join(first) and is_quick(first)):
        return found
    for outcome, asked in line.items():
        if asked.connection_id not in known and asked.may_join(first) and is_quick(asked):
            found.append((outcome, asked))
            if len(found) + 1 == most:
                break
        known.add(asked.connection_id)
    return found
