"""Telemetry: the metrics that /metrics shows, sent to an OpenTelemetry collector over OTLP/HTTP every now and then.

This module knows nothing about what is counted. It needs the extra `telemetry`, so whoever wants it imports it then. A
thread of its own converts and sends; a collector that is slow or gone costs log lines, and nothing else.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator

from opentelemetry.exporter.otlp.proto.http.metric_exporter import OTLPMetricExporter
from opentelemetry.sdk.metrics import export
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.util.instrumentation import InstrumentationScope
from prometheus_client.metrics_core import Metric
from prometheus_client.samples import Sample

from server.metrics import Metrics

__all__ = ["Telemetry", "converted"]

_SCOPE = InstrumentationScope("bot_runtime")
_TIMEOUT_S = 5.0
_GRACE_S = 1.0
_CUMULATIVE = export.AggregationTemporality.CUMULATIVE


class Telemetry:
    """Sends `metrics` to the collector at `endpoint`, a URL that ends in /v1/metrics, every `every_s` until closed."""

    def __init__(self, metrics: Metrics, endpoint: str, every_s: float) -> None:
        self._metrics, self._every_s = metrics, every_s
        self._resource = Resource.create({"service.name": "bot_runtime"})
        self._begun_ns = time.time_ns()  # what collectors understand; nothing here depends on it
        self._exporter = OTLPMetricExporter(endpoint=endpoint, timeout=_TIMEOUT_S)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._send, name="telemetry", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Send no more. What is being sent is given up."""
        self._ended.set()
        self._exporter.shutdown()
        self._thread.join(_GRACE_S)  # a collector that hangs must not hold up the end: the thread ends with the process

    def _send(self) -> None:
        while not self._ended.wait(self._every_s):
            metrics = [converted(family, self._begun_ns, time.time_ns()) for family in self._metrics.collect()]
            scope = export.ScopeMetrics(_SCOPE, metrics, schema_url="")
            self._exporter.export(export.MetricsData([export.ResourceMetrics(self._resource, [scope], schema_url="")]))


def converted(family: Metric, begun_ns: int, now_ns: int) -> export.Metric:
    """One family as OpenTelemetry's data: counters and histograms are cumulative since `begun_ns`."""
    unit = "s" if family.name.endswith("_seconds") else ""
    data: export.Sum | export.Gauge | export.Histogram
    if family.type == "histogram":
        data = export.Histogram(list(_histograms(family.samples, begun_ns, now_ns)), _CUMULATIVE)
    else:
        points = [
            export.NumberDataPoint(dict(sample.labels), begun_ns, now_ns, float(sample.value))
            for sample in family.samples
        ]
        is_counter = family.type == "counter"
        data = export.Sum(points, _CUMULATIVE, is_monotonic=True) if is_counter else export.Gauge(points)
    return export.Metric(family.name, family.documentation, unit, data)


def _histograms(samples: Iterable[Sample], begun_ns: int, now_ns: int) -> Iterator[export.HistogramDataPoint]:
    """Prometheus counts what is at or below a bound, OpenTelemetry what is between two."""
    bounds: list[float] = []
    counts: list[int] = []
    below = count = 0
    for sample in samples:  # of one histogram: its buckets by bound, then count and sum
        if sample.name.endswith("_bucket"):
            if sample.labels["le"] != "+Inf":
                bounds.append(float(sample.labels["le"]))
            counts.append(int(sample.value) - below)
            below = int(sample.value)
        elif sample.name.endswith("_count"):
            count = int(sample.value)
        else:
            yield export.HistogramDataPoint(
                attributes=dict(sample.labels),
                start_time_unix_nano=begun_ns,
                time_unix_nano=now_ns,
                count=count,
                sum=sample.value,
                bucket_counts=counts,
                explicit_bounds=bounds,
                min=None,  # type: ignore[arg-type]  # not kept; OTLP has them optional, this type has not
                max=None,  # type: ignore[arg-type]
            )
            bounds, counts, below, count = [], [], 0, 0
