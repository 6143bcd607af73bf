"""What every answered request leaves behind: counts in buckets that fit microseconds, cheap enough for every request.

This module knows nothing about Prometheus, sockets or bots. Whoever answers only notes that it has: counting takes
longer, and is done once the reply has left (`settle`), or by whoever reads. Both may be on any thread. What is read are
plain integers that only grow, each right by itself, and apart from each other by what is counted meanwhile.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque

from msgspec import Struct

from protocol.messages import Actions, Queries, Reply, Request, RequestQueries, SubmitFeatures, TakeTurn

__all__ = ["BATCH_BOUNDS", "NS_BOUNDS", "PHASES", "WHOLE", "Histograms", "Recorder", "Spans"]

# 1 µs to 3 s. 16,667 and 33,333 µs are frames at 60 and 30 Hz.
_BOUNDS_US = (1, 2, 3.5, 5, 7.5, 10, 15, 20, 30, 40, 50, 65, 80, 100, 130, 170, 220, 300, 400, 600, 1_000, 2_000, 5_000)
_LONG_BOUNDS_US = (10_000, 16_667, 33_333, 100_000, 300_000, 1_000_000, 3_000_000)
NS_BOUNDS = tuple(round(bound_us * 1e3) for bound_us in (*_BOUNDS_US, *_LONG_BOUNDS_US))
BATCH_BOUNDS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
PHASES = ("wait", "decode", "inference", "encode")
WHOLE = len(PHASES)  # the histogram after those of the phases
_MOST_NOTED = 64  # answers that wait to be counted: a server that is never idle counts them in between
_TURNS, _TURN_REPLIES = (RequestQueries, SubmitFeatures, TakeTurn), (Queries, Actions)


class Spans(Struct, frozen=True):
    """How long one request took, in ns: waiting for its turn, decoding, encoding, and from received to encoded."""

    wait_ns: int
    decode_ns: int
    encode_ns: int
    whole_ns: int


class _Noted(Struct, frozen=True):
    transport: str
    kind: type[Request]
    spans: Spans
    infer_us: float | None  # None: no turn, nor half of one
    n_bots: int


class Histograms:
    """Of one transport's requests of one type: ns in each phase, ns of the whole, and bots a message.

    `counts[i][j]` is how many of histogram i fell at or below bound j and above the one before it, `totals[i]` their
    sum. Where a message is no turn or half of one, only the whole is counted.
    """

    __slots__ = ("batches", "bots", "counts", "totals")

    def __init__(self) -> None:
        self.counts = tuple([0] * (len(NS_BOUNDS) + 1) for _ in range(WHOLE + 1))
        self.totals = [0] * (WHOLE + 1)
        self.batches = [0] * (len(BATCH_BOUNDS) + 1)
        self.bots = 0

    def count(self, whole_ns: int) -> None:
        """Add one request."""
        self.counts[WHOLE][bisect_left(NS_BOUNDS, whole_ns)] += 1
        self.totals[WHOLE] += whole_ns

    def count_half_turn(self, spans: Spans, infer_us: float, n_bots: int) -> None:
        """Add one request in all its phases. Written out rather than looped over, which takes twice as long."""
        wait_ns, decode_ns, encode_ns, whole_ns = spans.wait_ns, spans.decode_ns, spans.encode_ns, spans.whole_ns
        infer_ns = int(infer_us * 1e3)
        waits, decodes, inferences, encodes, wholes = self.counts
        waits[bisect_left(NS_BOUNDS, wait_ns)] += 1
        decodes[bisect_left(NS_BOUNDS, decode_ns)] += 1
        inferences[bisect_left(NS_BOUNDS, infer_ns)] += 1
        encodes[bisect_left(NS_BOUNDS, encode_ns)] += 1
        wholes[bisect_left(NS_BOUNDS, whole_ns)] += 1
        totals = self.totals
        totals[0] += wait_ns
        totals[1] += decode_ns
        totals[2] += infer_ns
        totals[3] += encode_ns
        totals[4] += whole_ns
        self.batches[bisect_left(BATCH_BOUNDS, n_bots)] += 1
        self.bots += n_bots


class Recorder:
    """What was answered, by transport and type of request, and what was refused, by transport and code."""

    def __init__(self) -> None:
        self.refusals: dict[tuple[str, str], int] = {}
        self._answers: dict[tuple[str, type[Request]], Histograms] = {}
        self._noted: deque[_Noted] = deque()
        self._counting, self._refusing = threading.Lock(), threading.Lock()

    @property
    def answers(self) -> dict[tuple[str, type[Request]], Histograms]:
        """All that were noted before, counted."""
        with self._counting:
            self._count_noted()
        return self._answers

    def answered(self, transport: str, request: Request, reply: Reply, spans: Spans) -> None:
        """Note one request that was answered as it asked for."""
        if isinstance(reply, _TURN_REPLIES) and isinstance(request, _TURNS):
            noted = _Noted(transport, type(request), spans, reply.infer_us, len(request.bots))
        else:
            noted = _Noted(transport, type(request), spans, None, 0)
        self._noted.append(noted)
        if len(self._noted) >= _MOST_NOTED:
            self.settle()

    def settle(self) -> None:
        """Count what was noted, unless another thread is counting, which is not waited for."""
        if self._counting.acquire(blocking=False):
            try:
                self._count_noted()
            finally:
                self._counting.release()

    def _count_noted(self) -> None:
        while self._noted:
            noted = self._noted.popleft()
            key = noted.transport, noted.kind
            histograms = self._answers.get(key)
            if histograms is None:
                histograms = self._answers[key] = Histograms()
            if noted.infer_us is None:
                histograms.count(noted.spans.whole_ns)
            else:
                histograms.count_half_turn(noted.spans, noted.infer_us, noted.n_bots)

    def refused(self, transport: str, code: str) -> None:
        """Count one request that was refused with this code."""
        with self._refusing:
            self.refusals[transport, code] = self.refusals.get((transport, code), 0) + 1
