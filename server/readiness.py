"""Readiness: the named checks that must pass before a new connection is sent here.

This module knows nothing about what is checked, or who asks. A check is cheap, never waits, and runs on the event loop.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Check", "Readiness"]

Check = Callable[[], str | None]


class Readiness:
    """Checks by name. A check returns None, or why it fails: a line for an operator, without anything secret.

    There is one from the beginning: `drain` fails as soon as `is_draining`, which whoever ends the server sets.
    """

    def __init__(self) -> None:
        self.is_draining = False
        self._checks: dict[str, Check] = {"drain": lambda: "the server is ending" if self.is_draining else None}

    @property
    def names(self) -> tuple[str, ...]:
        """The registered checks, in order."""
        return tuple(self._checks)

    def register(self, name: str, check: Check) -> None:
        """Ask this too, from now on. Raises ValueError for a name that is taken."""
        if name in self._checks:
            raise ValueError(f"there is a readiness check named {name!r} already")
        self._checks[name] = check

    def failing(self) -> dict[str, str]:
        """The checks that fail now, and why."""
        found = {name: check() for name, check in self._checks.items()}
        return {name: why for name, why in found.items() if why is not None}
