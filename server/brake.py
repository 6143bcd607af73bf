"""The brake: answers to wrong tokens wait once there have been many, so that guessing costs sockets and time.

This module knows nothing about tokens or doors. An answer to the right token never waits.
"""

from __future__ import annotations

import time
from collections.abc import Callable

__all__ = ["Brake"]

_N_FREE = 20
_WINDOW_S = 10.0
_WAIT_S = 1.0


class Brake:
    """`_N_FREE` wrong ones in `_WINDOW_S` are answered at once, each further one after `_WAIT_S`, whoever asks.

    It belongs to the event loop. `clock` counts seconds and is monotonic.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._begun_s, self._n_wrong = clock(), 0

    def wait_s(self) -> float:
        """How long the answer to one more wrong token is to wait."""
        now_s = self._clock()
        if now_s - self._begun_s >= _WINDOW_S:
            self._begun_s, self._n_wrong = now_s, 0
        self._n_wrong += 1
        return 0.0 if self._n_wrong <= _N_FREE else _WAIT_S
