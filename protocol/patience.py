"""Patience: a request repeated until a server answers it, over another connection if need be, or a limit has passed.

This module knows nothing about messages, or about what has to be done on another connection.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from protocol.errors import NoConnection, NotReady, TooManyBots, TooManyConnections

__all__ = ["Patience"]

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.005, 0.25
_BUSY = (NotReady, TooManyBots, TooManyConnections)  # a server that starts, or that has not missed us yet
T = TypeVar("T")


class Patience:
    """For at most `limit_s` from a request's first failure. `clock` is monotonic, in seconds, as `sleep` is."""

    def __init__(self, limit_s: float, clock: Callable[[], float], sleep: Callable[[float], object]) -> None:
        self._limit_s, self._clock, self._sleep = limit_s, clock, sleep

    def answer(
        self,
        first: Callable[[], T],
        again: Callable[[], T],
        resume: Callable[[], None],
        close: Callable[[], None],
        *,
        repeatable: bool = True,
    ) -> T:
        """The answer to `first`, or to `again` after `resume` has opened another connection.

        A request without an answer is sent again as it is: where the connection lives, that changes nothing unless it
        is not `repeatable`, and where it does not, the server says so. `close` ends what `resume` half made, and what a
        request that is not repeatable may have.
        """
        attempt, lost, give_up_s, pause_s = first, False, float("inf"), _FIRST_PAUSE_S
        while True:
            try:
                if lost:
                    resume()
                    attempt, lost = again, False
                return attempt()
            except (OSError, NoConnection, *_BUSY) as error:
                if isinstance(error, _BUSY) and give_up_s == float("inf"):
                    raise
                failure = error
            if lost or not (repeatable or isinstance(failure, _BUSY)):
                close()  # of what may have begun nobody heard: it must not stand in the way of what is begun instead
            lost = lost or not repeatable or isinstance(failure, NoConnection)
            now_s = self._clock()
            give_up_s = min(give_up_s, now_s + self._limit_s)
            if now_s >= give_up_s:
                raise failure
            self._sleep(pause_s)
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)
