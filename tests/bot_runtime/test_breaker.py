from __future__ import annotations

from bot_runtime.breaker import OVERRUNS, PROBE_NS, Breaker, Probe
from tests.bot_runtime.test_durations import Clock


def opened(clock: Clock) -> Breaker:
    breaker = Breaker(clock)
    for _ in range(OVERRUNS):
        breaker.report("act", 4, 900.0, overran=True)
    return breaker


def test_overruns_in_a_row_open_it_and_fewer_do_not() -> None:
    breaker = Breaker(Clock())
    for overran in (True, True, False, True, True):
        breaker.report("act", 1, 10.0, overran=overran)
        assert not breaker.is_open
    breaker.report("act", 1, 10.0, overran=True)
    assert (breaker.is_open, breaker.n_opened) == (True, 1)


def test_a_graph_that_is_fast_does_not_hide_one_that_is_slow() -> None:
    breaker = Breaker(Clock())
    for _ in range(OVERRUNS):
        breaker.report("query_probs", 4, 900.0, overran=False)
        breaker.report("act", 4, 900.0, overran=True)
    assert breaker.is_open


def test_a_probe_is_due_every_half_second_until_one_passes() -> None:
    clock = Clock()
    breaker = opened(clock)
    assert breaker.due() is None
    for _ in range(3):
        clock.ns += PROBE_NS - 1
        assert breaker.due() is None
        clock.ns += 1
        assert breaker.due() == Probe(4, 900.0)
        breaker.probed(900.5)
        assert breaker.is_open
    clock.ns += PROBE_NS
    breaker.probed(900.0)
    assert not breaker.is_open
    assert breaker.due() is None


def test_after_a_probe_it_takes_as_many_overruns_again() -> None:
    breaker = opened(Clock())
    breaker.probed(1.0)
    for expected in (False, False, True):
        breaker.report("act", 1, 10.0, overran=True)
        assert breaker.is_open is expected
    assert breaker.n_opened == 2
