"""The crowd: how many sockets of one port are open, whatever they turn out to be, and that it is not too many.

This module knows nothing about protocols. A socket counts from its first moment, before anybody has read from it.
"""

from __future__ import annotations

from protocol.errors import TooManyConnections

__all__ = ["Crowd"]


class Crowd:
    """At most `limit` sockets at a time. It belongs to the event loop."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._n_open = 0

    def __len__(self) -> int:
        return self._n_open

    def enter(self) -> None:
        """One more is open; raises TooManyConnections, and then it does not count."""
        if self._n_open >= self._limit:
            raise TooManyConnections(f"all {self._limit} sockets of this port are taken", retry_after_s=1.0)
        self._n_open += 1

    def leave(self) -> None:
        """One that counted has closed."""
        self._n_open -= 1
