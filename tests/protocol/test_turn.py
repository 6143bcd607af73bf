from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import protocol
from protocol.errors import FrameReused, NoPendingQuery, ProtocolError, StaleFrame
from protocol.turn import TRANSITIONS, Event, Order, Phase, diagram, is_retry, transition


def test_the_table_says_what_follows_in_every_case() -> None:
    assert set(TRANSITIONS) == set(product(Phase, Event, Order))


@pytest.mark.parametrize(
    ("phase", "last_frame", "event", "frame", "outcome"),
    [
        (Phase.IDLE, None, Event.QUERY, 0, Phase.PENDING),
        (Phase.IDLE, None, Event.FEATURES, 0, NoPendingQuery),
        (Phase.PENDING, 5, Event.FEATURES, 5, Phase.ANSWERED),
        (Phase.PENDING, 5, Event.FEATURES, 6, NoPendingQuery),
        (Phase.PENDING, 5, Event.FEATURES, 4, StaleFrame),
        (Phase.PENDING, 5, Event.QUERY, 5, Phase.PENDING),
        (Phase.PENDING, 5, Event.QUERY, 9, Phase.PENDING),
        (Phase.PENDING, 5, Event.QUERY, 4, StaleFrame),
        (Phase.IDLE, None, Event.TURN, 0, Phase.ANSWERED),
        (Phase.PENDING, 5, Event.TURN, 6, Phase.ANSWERED),
        (Phase.PENDING, 5, Event.TURN, 5, FrameReused),
        (Phase.PENDING, 5, Event.TURN, 4, StaleFrame),
        (Phase.ANSWERED, 5, Event.TURN, 6, Phase.ANSWERED),
        (Phase.ANSWERED, 5, Event.TURN, 5, Phase.ANSWERED),
        (Phase.ANSWERED, 5, Event.TURN, 4, StaleFrame),
        (Phase.ANSWERED, 5, Event.FEATURES, 5, Phase.ANSWERED),
        (Phase.ANSWERED, 5, Event.FEATURES, 6, NoPendingQuery),
        (Phase.ANSWERED, 5, Event.QUERY, 5, Phase.ANSWERED),
        (Phase.ANSWERED, 5, Event.QUERY, 7, Phase.PENDING),
        (Phase.ANSWERED, 5, Event.QUERY, 4, StaleFrame),
    ],
)
def test_what_may_follow_what(
    phase: Phase, last_frame: int | None, event: Event, frame: int, outcome: Phase | type[ProtocolError]
) -> None:
    if isinstance(outcome, Phase):
        assert transition(phase, last_frame, event, frame) is outcome
        return
    with pytest.raises(outcome) as refusal:
        transition(phase, last_frame, event, frame)
    assert str(frame) in refusal.value.detail
    assert phase.value in refusal.value.detail


@given(st.lists(st.tuples(st.sampled_from(Event), st.integers(0, 5)), max_size=30))
def test_whatever_arrives_frames_never_go_back_and_features_never_come_unasked(events: list[tuple[Event, int]]) -> None:
    phase, last_frame, asked = Phase.IDLE, None, set[int]()
    for event, frame in events:
        try:
            after = transition(phase, last_frame, event, frame)
        except ProtocolError:
            continue
        assert last_frame is None or frame >= last_frame
        if event is not Event.FEATURES:
            asked.add(frame)
        assert frame in asked
        if is_retry(phase, last_frame, event, frame):
            assert after is phase
        phase, last_frame = after, frame


def test_the_diagram_in_the_specification_is_drawn_from_the_table() -> None:
    text = (Path(protocol.__path__[0]) / "PROTOCOL.md").read_text("utf-8")
    assert diagram() in text
