from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import RequestQueries, SubmitFeatures
from server.pace import Pace

KIND = RequestQueries, 3
TIMES_US = st.lists(st.floats(1.0, 1e5), min_size=1, max_size=40)


@given(TIMES_US)
def test_an_estimate_is_never_far_from_what_was_measured(times_us: list[float]) -> None:
    pace = Pace()
    assert pace.expected_us(KIND) == float("inf")
    for took_us in times_us:
        pace.observe(KIND, took_us)
    assert 0.93 * min(times_us) <= pace.expected_us(KIND) <= max(times_us)
    assert pace.expected_us((SubmitFeatures, 3)) == float("inf")


def test_one_stall_at_most_doubles_it_for_ten_and_what_has_become_slow_is_believed_in_a_few() -> None:
    pace = Pace()
    for _ in range(50):
        pace.observe(KIND, 300.0)
    pace.observe(KIND, 90_000.0)
    assert 500.0 < pace.expected_us(KIND) <= 600.0
    for _ in range(10):
        pace.observe(KIND, 300.0)
    assert pace.expected_us(KIND) <= 300.0
    for _ in range(4):
        pace.observe(KIND, 2000.0)
    assert pace.expected_us(KIND) >= 0.93 * 2000.0


def test_wholes_are_by_kind_and_of_this_bundle_alone() -> None:
    pace, other = Pace(lambda: 0), Pace(lambda: 0)
    assert pace.whole_us(RequestQueries, 3) == 0.0
    for took_us in (900.0, 1000.0, 1100.0):
        pace.observe_whole(RequestQueries, 3, took_us)
    assert pace.whole_us(RequestQueries, 3) == 1000.0
    assert pace.whole_us(SubmitFeatures, 3) == other.whole_us(RequestQueries, 3) == 0.0
