"""What being watched costs: µs of a request that counting it takes, and how long a scrape holds up the event loop.

    python -m benchmarks.observing [--json]

Counting is `Recorder.answered` as `server.answer` calls it and what it leaves to `settle`, which a server does when the
reply has left, with the five looks at the clock that it takes. A scrape is the text of every transport and message in
use, the most that a server writes; between its pieces the event loop does other work, so what counts is the longest of
them. prometheus_client's own writer stands beside it. All of it is processor time of the one thread, so that other
processes' share of the machine does not count; the best of `rounds`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass

import tyro
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.metrics_core import Metric
from prometheus_client.registry import Collector

from protocol.messages import Actions, Farewell, Goodbye, Hello, Queries, RequestQueries, StartBots, SubmitFeatures
from server import families
from server.exposition import pieces
from server.recorder import Recorder, Spans

__all__ = ["Options", "measure"]

_QUERY, _QUERIES = RequestQueries(frame=1, bots=[1], free=b""), Queries(frame=1, queries=b"", cost_us=[], infer_us=23.0)
_ACT = SubmitFeatures(frame=1, bots=[1], acquired=b"", values=b"")
_ACTIONS = Actions(frame=1, actions=b"", reasons=[], infer_us=70.0)
_SPANS = Spans(1_000, 9_000, 4_000, 160_000)


@dataclass(frozen=True)
class Options:
    """What being watched costs."""

    requests: int = 20_000
    """Requests counted in a round."""
    rounds: int = 15
    """Rounds, of which the best is shown."""
    json: bool = False
    """One line of JSON."""


def measure(options: Options) -> dict[str, float]:
    """µs a counted request; kB, ms and longest piece in ms of a scrape; ms of prometheus_client's writer."""
    recorder = _used_everywhere()
    clock = time.monotonic_ns

    def count() -> None:
        for _ in range(options.requests):
            begun_ns = clock()
            clock(), clock(), clock(), clock()
            recorder.answered("tcp", _QUERY, _QUERIES, Spans(begun_ns, begun_ns, begun_ns, begun_ns))
            recorder.settle()

    text = "".join(pieces(families.requests(recorder)))
    registry = CollectorRegistry()
    registry.register(_Requests(recorder))
    return {
        "count_us": min(_ms(count) for _ in range(options.rounds)) * 1e3 / options.requests,
        "scrape_kb": len(text) / 1e3,
        "scrape_ms": min(_ms(lambda: list(pieces(families.requests(recorder)))) for _ in range(options.rounds)),
        "scrape_longest_ms": min(_longest_ms(recorder) for _ in range(options.rounds)),
        "own_writer_ms": min(_ms(lambda: generate_latest(registry)) for _ in range(options.rounds)),
    }


class _Requests(Collector):
    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def collect(self) -> list[Metric]:
        return list(families.requests(self._recorder))


def _used_everywhere() -> Recorder:
    recorder = Recorder()
    for transport in ("http", "tcp", "unix", "ws"):
        recorder.answered(transport, _QUERY, _QUERIES, _SPANS)
        recorder.answered(transport, _ACT, _ACTIONS, _SPANS)
        for request in (Hello(protocol=1), StartBots(count=1), Goodbye()):
            recorder.answered(transport, request, Farewell(), _SPANS)
    return recorder


def _ms(run: Callable[[], object]) -> float:
    begun_ns = time.thread_time_ns()
    run()
    return (time.thread_time_ns() - begun_ns) / 1e6


def _longest_ms(recorder: Recorder) -> float:
    longest_ns, begun_ns = 0, time.thread_time_ns()
    for _ in pieces(families.requests(recorder)):
        now_ns = time.thread_time_ns()
        longest_ns, begun_ns = max(longest_ns, now_ns - begun_ns), now_ns
    return longest_ns / 1e6


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Options)
    found = measure(options)
    if options.json:
        print(json.dumps({name: round(number, 3) for name, number in found.items()}))
        return
    print(f"counting a request          {found['count_us']:8.2f} µs")
    print(f"a scrape of {found['scrape_kb']:4.0f} kB          {found['scrape_ms']:8.2f} ms")
    print(f"  its longest piece         {found['scrape_longest_ms']:8.2f} ms")
    print(f"  by prometheus_client      {found['own_writer_ms']:8.2f} ms, in one piece")


if __name__ == "__main__":
    main()
