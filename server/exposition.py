"""The text that Prometheus scrapes, in its format 0.0.4, in pieces that are short enough to write between two frames.

This module knows nothing about what is counted. prometheus_client's own writer writes everything at once, up to 13 ms
in which no bot would be answered; pieces here take at most 1.4 (`benchmarks.observing`). Its parser reads them in the
tests.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from prometheus_client.metrics_core import Metric
from prometheus_client.samples import Sample

__all__ = ["CONTENT_TYPE", "pieces"]

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_SAMPLES_A_PIECE = 100
_ESCAPES = str.maketrans({"\\": r"\\", "\n": r"\n", '"': r"\""})


def pieces(families: Iterable[Metric]) -> Iterator[str]:
    """The text of these families, some lines at a time."""
    for family in families:
        name = f"{family.name}_total" if family.type == "counter" else family.name
        help_text = family.documentation.replace("\\", r"\\").replace("\n", r"\n")
        yield f"# HELP {name} {help_text}\n# TYPE {name} {family.type}\n"
        for begin in range(0, len(family.samples), _SAMPLES_A_PIECE):
            yield "".join(map(_line, family.samples[begin : begin + _SAMPLES_A_PIECE]))


def _line(sample: Sample) -> str:
    value = f"{sample.value:g}" if sample.value in (float("inf"), float("-inf")) else repr(sample.value)
    if not sample.labels:
        return f"{sample.name} {value}\n"
    labels = ",".join([f'{label}="{text.translate(_ESCAPES)}"' for label, text in sample.labels.items()])
    return f"{sample.name}{{{labels}}} {value}\n"
