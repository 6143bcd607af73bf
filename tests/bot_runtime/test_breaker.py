from __future__ import annotations

from bot_runtime.breaker import OVERRUNS, PAUSES_NS, Breaker, Probe
from tests.bot_runtime.test_durations import Clock


def opened(clock: Clock) -> Breaker:
    breaker = Breaker(clock)
    for _ in range(OVERRUNS):
        breaker.report("act", Probe(4, 900.0), overran=True)
    return breaker


def test_overruns_in_a_row_open_it_and_fewer_do_not() -> None:
    breaker = Breaker(Clock())
    for overran in (True, True, False, True, True):
        breaker.report("act", Probe(1, 10.0), overran=overran)
        assert not breaker.is_open
    breaker.report("act", Probe(1, 10.0), overran=True)
    assert (breaker.is_open, breaker.n_opened) == (True, 1)


def test_a_graph_that_is_fast_does_not_hide_one_that_is_slow() -> None:
    breaker = Breaker(Clock())
    for _ in range(OVERRUNS):
        breaker.report("query_probs", Probe(4, 900.0), overran=False)
        breaker.report("act", Probe(4, 900.0), overran=True)
    assert breaker.is_open


def test_probes_are_due_soon_then_less_often_until_one_passes() -> None:
    clock = Clock()
    breaker = opened(clock)
    assert breaker.due() is None
    for pause_ns in (*PAUSES_NS, PAUSES_NS[-1]):
        clock.ns += pause_ns - 1
        assert breaker.due() is None
        clock.ns += 1
        assert breaker.due() == Probe(4, 900.0)
        breaker.probed(900.5)
        assert breaker.is_open
    clock.ns += PAUSES_NS[-1]
    breaker.probed(900.0)
    assert not breaker.is_open
    assert breaker.due() is None


def test_after_a_probe_it_takes_as_many_overruns_again() -> None:
    breaker = opened(Clock())
    breaker.probed(1.0)
    for expected in (False, False, True):
        breaker.report("act", Probe(1, 10.0), overran=True)
        assert breaker.is_open is expected
    assert breaker.n_opened == 2
    clock = breaker._clock
    clock.ns += PAUSES_NS[0]
    assert breaker.due() is not None  # as soon as the first time
