"""What may follow what in one bot's turn, as a table.

This module knows nothing about messages, models or time: it is a pure function of a bot's phase, the last frame it saw,
what arrives and for which frame. Whether a repeated frame also has the *same content* is for the caller to compare
(`is_retry` says when to).
"""

from __future__ import annotations

from enum import Enum

from protocol.errors import FrameReused, NoPendingQuery, ProtocolError, StaleFrame

__all__ = ["TRANSITIONS", "Event", "Order", "Phase", "diagram", "is_retry", "transition"]


class Phase(Enum):
    """Where a bot is in its turn."""

    IDLE = "idle"  # started, no frame yet
    PENDING = "pending"  # a query was answered, features are awaited
    ANSWERED = "answered"  # features came, the action was answered
    __hash__ = object.__hash__  # of Enum's own, every look-up in the table pays for a call


class Event(Enum):
    """What arrives from the engine."""

    QUERY = "request_queries"
    FEATURES = "submit_features"
    TURN = "take_turn"  # both at once
    __hash__ = object.__hash__


class Order(Enum):
    """The arriving frame number compared with the last one that the bot saw."""

    OLDER = "older frame"
    SAME = "same frame"
    NEWER = "newer frame"
    __hash__ = object.__hash__


TRANSITIONS: dict[tuple[Phase, Event, Order], Phase | type[ProtocolError]] = {
    (Phase.IDLE, Event.QUERY, Order.NEWER): Phase.PENDING,
    (Phase.IDLE, Event.QUERY, Order.SAME): StaleFrame,
    (Phase.IDLE, Event.QUERY, Order.OLDER): StaleFrame,
    (Phase.IDLE, Event.FEATURES, Order.NEWER): NoPendingQuery,
    (Phase.IDLE, Event.FEATURES, Order.SAME): NoPendingQuery,
    (Phase.IDLE, Event.FEATURES, Order.OLDER): NoPendingQuery,
    (Phase.IDLE, Event.TURN, Order.NEWER): Phase.ANSWERED,
    (Phase.IDLE, Event.TURN, Order.SAME): StaleFrame,
    (Phase.IDLE, Event.TURN, Order.OLDER): StaleFrame,
    # A newer frame abandons the pending query: engines may skip a turn, and the context does not advance.
    (Phase.PENDING, Event.QUERY, Order.NEWER): Phase.PENDING,
    (Phase.PENDING, Event.QUERY, Order.SAME): Phase.PENDING,
    (Phase.PENDING, Event.QUERY, Order.OLDER): StaleFrame,
    (Phase.PENDING, Event.FEATURES, Order.NEWER): NoPendingQuery,
    (Phase.PENDING, Event.FEATURES, Order.SAME): Phase.ANSWERED,
    (Phase.PENDING, Event.FEATURES, Order.OLDER): StaleFrame,
    (Phase.PENDING, Event.TURN, Order.NEWER): Phase.ANSWERED,
    (Phase.PENDING, Event.TURN, Order.SAME): FrameReused,
    (Phase.PENDING, Event.TURN, Order.OLDER): StaleFrame,
    (Phase.ANSWERED, Event.QUERY, Order.NEWER): Phase.PENDING,
    (Phase.ANSWERED, Event.QUERY, Order.SAME): Phase.ANSWERED,
    (Phase.ANSWERED, Event.QUERY, Order.OLDER): StaleFrame,
    (Phase.ANSWERED, Event.FEATURES, Order.NEWER): NoPendingQuery,
    (Phase.ANSWERED, Event.FEATURES, Order.SAME): Phase.ANSWERED,
    (Phase.ANSWERED, Event.FEATURES, Order.OLDER): StaleFrame,
    (Phase.ANSWERED, Event.TURN, Order.NEWER): Phase.ANSWERED,
    (Phase.ANSWERED, Event.TURN, Order.SAME): Phase.ANSWERED,
    (Phase.ANSWERED, Event.TURN, Order.OLDER): StaleFrame,
}


def transition(phase: Phase, last_frame: int | None, event: Event, frame: int) -> Phase:
    """The phase after `event` for `frame`, given the last frame that this bot saw (None before its first).

    Raises StaleFrame, NoPendingQuery or FrameReused where the table says so; the caller's state is then to stay as it
    was.
    """
    outcome = TRANSITIONS[phase, event, _order(last_frame, frame)]
    if isinstance(outcome, Phase):
        return outcome
    seen = "no frame yet" if last_frame is None else f"frame {last_frame}"
    raise outcome(f"{event.value} for frame {frame} does not fit a bot that is {phase.value} and has seen {seen}")


def is_retry(phase: Phase, last_frame: int | None, event: Event, frame: int) -> bool:
    """Whether a legal event repeats one already answered, so that its reply must be repeated and nothing advances."""
    return last_frame == frame and (event is Event.QUERY or phase is Phase.ANSWERED)


def diagram() -> str:
    """The legal transitions as a Mermaid state diagram; PROTOCOL.md shows this text and a test compares them."""
    lines = ["stateDiagram-v2", "    [*] --> idle: start_bots"]
    for (phase, event, order), outcome in TRANSITIONS.items():
        if isinstance(outcome, Phase):
            lines.append(f"    {phase.value} --> {outcome.value}: {event.value}, {order.value}")
    return "\n".join([*lines, *(f"    {phase.value} --> [*]: stop_bots" for phase in Phase)])


def _order(last_frame: int | None, frame: int) -> Order:
    if last_frame is None or frame > last_frame:
        return Order.NEWER
    return Order.SAME if frame == last_frame else Order.OLDER
