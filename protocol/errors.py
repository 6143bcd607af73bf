"""One exception tree: every way a request can be refused, each with its wire code and its HTTP status.

This module knows nothing about messages, transports or bots. THREATS calls for codes that never change: a client in
another language switches on `code`, a person reads `detail`.
"""

from __future__ import annotations

from typing import ClassVar

__all__ = [
    "ERRORS_BY_CODE",
    "BadBundle",
    "BadJson",
    "BadMsgpack",
    "BadSchema",
    "BadShape",
    "FrameReused",
    "InternalError",
    "MethodNotAllowed",
    "MissingFeature",
    "NoBot",
    "NoBundle",
    "NoConnection",
    "NoPendingQuery",
    "NoRoute",
    "NonFinite",
    "NotReady",
    "OutOfRange",
    "OverBudget",
    "ProtocolError",
    "StaleFrame",
    "TooDeep",
    "TooLarge",
    "TooManyBots",
    "TooManyConnections",
    "Unauthorized",
    "UnrequestedFeature",
    "UnsupportedMediaType",
]


class ProtocolError(Exception):
    """A refused request. `code` and `status` belong to the class; `detail` says what was wrong, where, what fits."""

    code: ClassVar[str]
    status: ClassVar[int]

    def __init__(self, detail: str, *, retry_after_s: float | None = None) -> None:
        super().__init__(detail)
        self.detail = detail
        self.retry_after_s = retry_after_s

    def __str__(self) -> str:
        return f"{self.code}: {self.detail}"


class BadMsgpack(ProtocolError):
    """The body is not one whole msgpack value: malformed, truncated, or followed by other bytes."""

    code, status = "BAD_MSGPACK", 400


class BadJson(ProtocolError):
    """The body is not one whole JSON value."""

    code, status = "BAD_JSON", 400


class TooDeep(ProtocolError):
    """The body is nested deeper than any message."""

    code, status = "TOO_DEEP", 400


class Unauthorized(ProtocolError):
    """The token is missing or wrong."""

    code, status = "UNAUTHORIZED", 401


class NoBundle(ProtocolError):
    """No such bundle is served, or several are and none was named."""

    code, status = "NO_BUNDLE", 404


class NoBot(ProtocolError):
    """This connection owns no such bot (another connection may: that looks the same)."""

    code, status = "NO_BOT", 404


class NoConnection(ProtocolError):
    """No such connection: never opened, closed, idle for too long, or from before a restart."""

    code, status = "NO_CONNECTION", 404


class NoRoute(ProtocolError):
    """HTTP only: nothing is served at this path."""

    code, status = "NO_ROUTE", 404


class MethodNotAllowed(ProtocolError):
    """HTTP only: this path is served, by another method."""

    code, status = "METHOD_NOT_ALLOWED", 405


class NoPendingQuery(ProtocolError):
    """Features arrived for bots and a frame that no query is pending for."""

    code, status = "NO_PENDING_QUERY", 409


class FrameReused(ProtocolError):
    """The frame was sent before, with other content."""

    code, status = "FRAME_REUSED", 409


class StaleFrame(ProtocolError):
    """The frame number went back."""

    code, status = "STALE_FRAME", 409


class TooLarge(ProtocolError):
    """The body is larger than the limit that Welcome names."""

    code, status = "TOO_LARGE", 413


class UnsupportedMediaType(ProtocolError):
    """The content type is neither application/msgpack nor application/json."""

    code, status = "UNSUPPORTED_MEDIA_TYPE", 415


class BadSchema(ProtocolError):
    """The body is not one of the messages: unknown field, wrong type, a number outside what its field allows."""

    code, status = "BAD_SCHEMA", 422


class BadShape(ProtocolError):
    """An array has the wrong shape; the detail names it, what was expected and what came."""

    code, status = "BAD_SHAPE", 422


class NonFinite(ProtocolError):
    """A number is NaN or infinite."""

    code, status = "NON_FINITE", 422


class OutOfRange(ProtocolError):
    """A number lies outside the range that its feature declares."""

    code, status = "OUT_OF_RANGE", 422


class OverBudget(ProtocolError):
    """What the engine acquired on its own decision costs more than a budget, by the costs that count."""

    code, status = "OVER_BUDGET", 422


class UnrequestedFeature(ProtocolError):
    """Values came for a feature that was not asked for."""

    code, status = "UNREQUESTED_FEATURE", 422


class MissingFeature(ProtocolError):
    """A feature that was asked for neither came nor was marked failed."""

    code, status = "MISSING_FEATURE", 422


class BadBundle(ProtocolError):
    """A bundle is corrupt, truncated, tampered with or does not compute what it was recorded to compute."""

    code, status = "BAD_BUNDLE", 422


class TooManyBots(ProtocolError):
    """Every bot slot is taken; try again after `retry_after_s`."""

    code, status = "TOO_MANY_BOTS", 429


class TooManyConnections(ProtocolError):
    """Every connection is taken; try again after `retry_after_s`."""

    code, status = "TOO_MANY_CONNECTIONS", 429


class InternalError(ProtocolError):
    """The server failed; the bots are as they were. Says nothing about why on purpose."""

    code, status = "INTERNAL", 500


class NotReady(ProtocolError):
    """The server is starting, draining or has more work queued than it accepts."""

    code, status = "NOT_READY", 503


ERRORS_BY_CODE: dict[str, type[ProtocolError]] = {error.code: error for error in ProtocolError.__subclasses__()}
