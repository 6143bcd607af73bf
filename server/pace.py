"""Pace: how long requests of one bundle take, so that what is quick need not leave the event loop.

This module knows nothing about what a request does, or who waits for it.
"""

from __future__ import annotations

from protocol.messages import Request

__all__ = ["Kind", "Pace"]

Kind = tuple[type[Request], int]  # and the number of bits in its number of bots: sizes within a factor of two


class Pace:
    """How long requests take, by kind and size: about their 90 % quantile, by steps up and down, in µs.

    One odd measurement doubles an estimate; it takes ten good ones to take that back.
    """

    def __init__(self) -> None:
        self._us: dict[Kind, float] = {}

    def expected_us(self, kind: Kind) -> float:
        """What the next one is expected to take; infinite before the first."""
        return self._us.get(kind, float("inf"))

    def observe(self, kind: Kind, took_us: float) -> None:
        """One has taken so long."""
        known_us = self._us.get(kind)
        if known_us is None:
            self._us[kind] = took_us
        else:
            self._us[kind] = known_us * (2.0 if took_us > known_us else 0.93)
