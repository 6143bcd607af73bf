"""Tokens: read from files, and compared without telling how much of a guess was right.

This module knows nothing about what a token opens.
"""

from __future__ import annotations

import hmac
from pathlib import Path

from protocol.errors import Unauthorized

__all__ = ["MIN_CHARS", "bearer", "check", "read_token"]

MIN_CHARS, _MAX_CHARS = 16, 1024  # so few that are random cannot be guessed at any rate


def read_token(path: Path) -> str:
    """The first and only line of this file. Raises OSError, ValueError."""
    with path.open(encoding="utf-8") as file:
        content = file.read(_MAX_CHARS + 2)
    token = content.removesuffix("\n").removesuffix("\r")
    if not MIN_CHARS <= len(token) <= _MAX_CHARS or not token.isprintable():
        expected = f"expected one line of {MIN_CHARS} to {_MAX_CHARS} printable characters"
        raise ValueError(f"{path} holds no token: {expected}")
    return token


def check(given: str | None, expected: str) -> None:
    """Raise Unauthorized unless these are the same; takes equally long wherever they differ."""
    if given is None or not hmac.compare_digest(given.encode(), expected.encode()):
        raise Unauthorized("the token is missing or wrong")


def bearer(authorization: str) -> str | None:
    """The token in an `Authorization` header, whose bytes were read as Latin-1 as HTTP says; None if there is none."""
    scheme, _, token = authorization.partition(" ")
    if scheme.lower() != "bearer":
        return None
    try:
        return token.encode("latin-1").decode()
    except UnicodeError:
        return None
