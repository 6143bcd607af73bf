"""Metric families: what the parts of a server have counted, under the names, labels and units that Prometheus expects.

This module knows nothing about HTTP or how parts count. Each function reads plain numbers and may be called from any
thread. docs/operations.md says what each metric means; a test holds it, and the dashboard, to what is written here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate
from typing import TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric

from bot_runtime.together import BOUNDS
from server.due import Due
from server.recorder import BATCH_BOUNDS, NS_BOUNDS, PHASES, WHOLE, Recorder
from server.serving import Serving

__all__ = ["bundles", "deadlines", "gauge", "readiness", "requests", "sockets"]

Labels = TypeVar("Labels", bound=tuple[str, ...])
_SECONDS = [f"{bound / 1e9:g}" for bound in NS_BOUNDS]
_BATCHES = [str(bound) for bound in BATCH_BOUNDS]
_CONNECTIONS = [str(bound) for bound in BOUNDS]
_BUNDLE = ("bundle", "version")
_SPENT_US = {  # of `bot_runtime.spent.Spent`: the metric that it becomes, in seconds
    "allowed_us": ("budget_allowed", "What budgets would have let bots ask for, never more than everything costs."),
    "asked_us": ("query_cost", "Predicted cost of what bots asked for."),
    "measured_us": ("acquire_measured", "What acquiring took, where engines say so."),
    "predicted_us": ("acquire_predicted", "What had been predicted for what was acquired and measured."),
    "error_us": ("acquire_error", "Sum of |measured - predicted| over measured frames."),
}
_COUNTED = {  # of `bot_runtime.spent.Spent`
    "n_measured": ("frames_measured", "Frames of which an engine says how long acquiring took."),
    "n_over_predicted": ("frames_over_predicted", "Measured frames that took longer than predicted."),
    "n_over_budget": ("frames_over_budget", "Measured frames that took longer than their budget."),
}


def requests(recorder: Recorder) -> Iterator[Metric]:
    """Time of whole requests and of their phases, bots a message, and refusals; each built when it is asked for."""
    answers = [
        ([transport, str(kind.__struct_config__.tag)], histograms)
        for (transport, kind), histograms in list(recorder.answers.items())
    ]
    turns = [(labels, histograms) for labels, histograms in answers if any(histograms.batches)]
    help_text = "From a request read whole to its reply encoded."
    whole = _histogram("request_seconds", help_text, ("transport", "message"))
    for labels, histograms in answers:
        _fill(whole, labels, _SECONDS, histograms.counts[WHOLE], histograms.totals[WHOLE] / 1e9)
    yield whole
    help_text = "Of a turn or half of one: waiting for its turn, decoding, inference, encoding."
    phase = _histogram("request_phase_seconds", help_text, ("transport", "message", "phase"))
    for labels, histograms in turns:
        for index, name in enumerate(PHASES):
            _fill(phase, [*labels, name], _SECONDS, histograms.counts[index], histograms.totals[index] / 1e9)
    yield phase
    bots = _histogram("message_bots", "Bots in one message of a turn.", ("transport", "message"))
    for labels, histograms in turns:
        _fill(bots, labels, _BATCHES, histograms.batches, histograms.bots)
    yield bots
    yield _counter("refused", "Refused requests.", ("transport", "code"), dict(recorder.refusals))


def bundles(servings: Iterable[Serving]) -> Iterator[Metric]:
    """Of each bundle in memory: bots, connections, rungs of the fallback ladder, budgets and measured costs."""
    by_bundle: dict[tuple[str, str], list[Serving]] = {}
    for serving in servings:
        by_bundle.setdefault((serving.name, _version(serving)), []).append(serving)
    known = {
        (*key, first.sha256, first.manifest.method, first.manifest.precision): 1.0
        for key, (first, *_) in by_bundle.items()
    }
    yield gauge("bundle_info", "1 for each bundle.", (*_BUNDLE, "sha256", "method", "precision"), known)

    def summed(number: str, of: str | None = None) -> dict[tuple[str, ...], float]:
        return {
            key: sum(getattr(each.bots if of is None else getattr(each.bots, of), number) for each in group)
            for key, group in by_bundle.items()
        }

    yield gauge("bots", "Bots.", _BUNDLE, summed("n_bots"))
    held = {key: sum(each.n_connections for each in group) for key, group in by_bundle.items()}
    yield gauge("bundle_connections", "Connections that hold a bundle.", _BUNDLE, held)
    rungs = {"queries": "query_reasons", "actions": "reasons"}
    for name, counted in rungs.items():
        numbers: Counter[tuple[str, ...]] = Counter()
        for key, group in by_bundle.items():
            for each in group:
                by_reason = getattr(each.bots.counters, counted)
                numbers.update({(*key, reason.name.lower()): n for reason, n in by_reason.items()})
        yield _counter(name, f"Bots' {name} by the rung of the fallback ladder.", (*_BUNDLE, "reason"), numbers)
    skipped, abandoned = summed("skipped_frames", "counters"), summed("abandoned_queries", "counters")
    yield _counter("skipped_frames", "Frame numbers that a bot never saw.", _BUNDLE, skipped)
    yield _counter("abandoned_queries", "Pending queries that a newer frame replaced.", _BUNDLE, abandoned)
    opened = {key: sum(each.bots.haste.breaker.n_opened for each in group) for key, group in by_bundle.items()}
    yield _counter("breaker_opened", "Times that a bundle was too slow too often.", _BUNDLE, opened)
    joined = _histogram("batch_connections", "Connections whose turns were inferred as one batch.", _BUNDLE)
    for key, group in by_bundle.items():
        together = [each.bots.together for each in group]
        counts = [sum(column) for column in zip(*(each.counts for each in together), strict=True)]
        _fill(joined, list(key), _CONNECTIONS, counts, sum(each.n_batches for each in together))
    yield joined
    for number, (name, help_text) in _SPENT_US.items():
        in_s = {key: us / 1e6 for key, us in summed(number, "spent").items()}
        yield _counter(f"{name}_seconds", help_text, _BUNDLE, in_s)
    for number, (name, help_text) in _COUNTED.items():
        yield _counter(name, help_text, _BUNDLE, summed(number, "spent"))


def deadlines(due: Due) -> Iterator[Metric]:
    """Requests that their deadline was too short for, by what became of them."""
    became = {("refused",): due.n_refused, ("timed_out",): due.n_timed_out, ("late",): due.n_late}
    yield _counter("deadlines_missed", "Requests whose deadline was too short.", ("outcome",), became)


def readiness(names: Sequence[str], failing: Mapping[str, str]) -> Iterator[Metric]:
    """What /readyz says, as numbers."""
    yield gauge("ready", "Whether a new connection would be served.", (), {(): float(not failing)})
    passed = {(name,): float(name not in failing) for name in names}
    yield gauge("ready_check", "Whether a check of /readyz passes.", ("check",), passed)


def sockets(n_open: Mapping[str, int]) -> Iterator[Metric]:
    """Open sockets by transport."""
    yield gauge("sockets", "Open sockets.", ("transport",), {(transport,): n for transport, n in n_open.items()})


def gauge(name: str, help_text: str, labels: Sequence[str], numbers: Mapping[Labels, float]) -> Metric:
    """A gauge of these numbers by the values of its labels."""
    family = GaugeMetricFamily(f"bot_runtime_{name}", help_text, labels=labels)
    for values, number in numbers.items():
        family.add_metric(list(values), number)
    return family


def _counter(name: str, help_text: str, labels: Sequence[str], numbers: Mapping[Labels, float]) -> Metric:
    family = CounterMetricFamily(f"bot_runtime_{name}", help_text, labels=labels)
    for values, number in numbers.items():
        family.add_metric(list(values), number)
    return family


def _histogram(name: str, help_text: str, labels: Sequence[str]) -> HistogramMetricFamily:
    return HistogramMetricFamily(f"bot_runtime_{name}", help_text, labels=labels)


def _fill(family: HistogramMetricFamily, labels: list[str], bounds: list[str], counts: list[int], total: float) -> None:
    buckets = list(zip([*bounds, "+Inf"], accumulate(counts), strict=True))
    family.add_metric(labels, buckets, total)


def _version(serving: Serving) -> str:
    """Its number in the store, or the beginning of its hash: two bundles of one name are told apart by it."""
    return serving.sha256[:12] if serving.version is None else str(serving.version)
