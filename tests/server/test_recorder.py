"""Counting: every number in the bucket that it belongs to, every request once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from protocol.messages import Farewell, Goodbye, Queries, RequestQueries
from server.recorder import NS_BOUNDS, PHASES, WHOLE, Recorder, Spans

REQUEST = RequestQueries(frame=1, bots=[1, 2, 3], free=b"")
ns = st.integers(0, 2 * NS_BOUNDS[-1]) | st.sampled_from([bound + off for bound in NS_BOUNDS for off in (-1, 0, 1)])


@given(st.lists(st.tuples(ns, ns, ns, ns, st.floats(0.0, 1e7)), min_size=1, max_size=20))
def test_every_phase_is_in_its_bucket(durations: list[tuple[int, int, int, int, float]]) -> None:
    """Against the definition: le is inclusive."""
    recorder, expected = Recorder(), []
    for wait, decode, handle, encode, infer_us in durations:
        spans = Spans(wait, decode, encode, wait + decode + handle + encode)
        reply = Queries(frame=1, queries=b"", cost_us=[], infer_us=infer_us)
        recorder.answered("tcp", REQUEST, reply, spans)
        expected.append((wait, decode, int(infer_us * 1e3), encode, spans.whole_ns))
    histograms = recorder.answers["tcp", RequestQueries]
    assert len(PHASES) == WHOLE == 4
    for index, numbers in enumerate(zip(*expected, strict=True)):
        cumulative = np.cumsum(histograms.counts[index])
        assert [sum(number <= bound for number in numbers) for bound in NS_BOUNDS] == cumulative[:-1].tolist()
        assert (cumulative[-1], histograms.totals[index]) == (len(numbers), sum(numbers))
    assert (histograms.bots, sum(histograms.batches)) == (3 * len(durations), len(durations))
    assert histograms.batches[2] == len(durations)  # 3 bots: above 2, at most 4


def test_what_was_noted_is_counted_once_by_whoever_reads_and_never_waits_in_numbers() -> None:
    recorder = Recorder()
    reply = Queries(frame=1, queries=b"", cost_us=[], infer_us=1.0)
    for answered in range(1, 201):
        recorder.answered("tcp", REQUEST, reply, Spans(1, 2, 3, 6))
        assert len(recorder._noted) < 64
        if answered % 70 == 0:
            recorder.settle()
            assert not recorder._noted
    assert [sum(recorder.answers["tcp", RequestQueries].counts[WHOLE]) for _ in range(2)] == [200, 200]


def test_threads_that_answer_settle_and_read_lose_nothing() -> None:
    recorder, reply = Recorder(), Queries(frame=1, queries=b"", cost_us=[], infer_us=1.0)

    def answer() -> None:
        for _ in range(3000):
            recorder.answered("tcp", REQUEST, reply, Spans(1, 2, 3, 6))

    def look() -> None:
        for _ in range(300):
            recorder.settle()
            assert not recorder.answers or recorder.answers["tcp", RequestQueries].bots % 3 == 0

    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(work) for work in (answer, look, answer, look)]:
            done.result()
    histograms = recorder.answers["tcp", RequestQueries]
    assert [sum(counts) for counts in histograms.counts] == [6000] * 5
    assert histograms.totals == [6000, 12000, 6_000_000, 18000, 36000]


def test_what_is_no_turn_has_no_phases() -> None:
    recorder = Recorder()
    recorder.answered("http", Goodbye(), Farewell(), Spans(1, 2, 3, 1500))
    histograms = recorder.answers["http", Goodbye]
    assert (sum(histograms.counts[WHOLE]), histograms.totals) == (1, [0, 0, 0, 0, 1500])
    assert not any(histograms.batches)


def test_refusals_are_counted_by_transport_and_code() -> None:
    recorder = Recorder()
    for transport, code in (("tcp", "NO_BOT"), ("tcp", "NO_BOT"), ("http", "NO_BOT"), ("tcp", "NOT_READY")):
        recorder.refused(transport, code)
    assert recorder.refusals == {("tcp", "NO_BOT"): 2, ("http", "NO_BOT"): 1, ("tcp", "NOT_READY"): 1}
