"""The text format: whatever is counted, Prometheus' own parser reads the same back."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from server.exposition import pieces

texts = st.text(st.characters(exclude_categories=("Cs", "Cc", "Zl", "Zp")) | st.just("\n"), max_size=12)
numbers = st.floats(allow_nan=False) | st.integers(0, 10**15)


def read(text: str) -> list[tuple[str, str, dict[str, str], float]]:
    return [
        (family.type, sample.name, sample.labels, sample.value)
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    ]


def written(families: list[Metric]) -> list[tuple[str, str, dict[str, str], float]]:
    return [(family.type, sample.name, sample.labels, sample.value) for family in families for sample in family.samples]


@given(st.dictionaries(st.tuples(texts, texts), numbers, max_size=250), texts)
def test_what_was_counted_is_read_back(values: dict[tuple[str, str], float], help_text: str) -> None:
    gauge = GaugeMetricFamily("a_gauge", help_text, labels=["one", "two"])
    counter = CounterMetricFamily("a_counter", "Counts.", labels=["one", "two"])
    for labels, number in values.items():
        gauge.add_metric(list(labels), number)
        counter.add_metric(list(labels), abs(number))
    alone = GaugeMetricFamily("alone", "No labels.", value=3)
    assert read("".join(pieces([gauge, counter, alone]))) == written([gauge, counter, alone])


def test_histograms_and_infinities() -> None:
    histogram = HistogramMetricFamily("h_seconds", "Time.", labels=["a"])
    histogram.add_metric(["x"], [("1e-06", 1), ("0.0015", 4), ("+Inf", 9)], 1.5e-3)
    gauge = GaugeMetricFamily("g", "", labels=["a"])
    for label, number in (("low", -math.inf), ("high", math.inf)):
        gauge.add_metric([label], number)
    text = "".join(pieces([histogram, gauge]))
    assert read(text) == written([histogram, gauge])
    assert 'h_seconds_bucket{a="x",le="0.0015"} 4\n' in text
    assert "# TYPE h_seconds histogram\n" in text


def test_pieces_are_short() -> None:
    gauge = GaugeMetricFamily("g", "", labels=["a"])
    for label in range(1000):
        gauge.add_metric([str(label)], label)
    assert max(piece.count("\n") for piece in pieces([gauge])) <= 100
