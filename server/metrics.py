"""Metrics: everything that the parts of a server count, as the text that Prometheus scrapes.

This module knows nothing about what is counted: parts register a source, and a source is read when somebody asks.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Iterator

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.metrics_core import Metric

from server.exposition import pieces

__all__ = ["Metrics"]

Source = Callable[[], Iterable[Metric]]


class Metrics:
    """The sources of one server, and the process's own memory, CPU time and file descriptors."""

    def __init__(self) -> None:
        self._sources: list[Source] = [ProcessCollector(registry=CollectorRegistry()).collect]

    def register(self, source: Source) -> None:
        """Read this too, from now on. It may be called from any thread."""
        self._sources.append(source)

    def collect(self) -> Iterator[Metric]:
        """Every family, as it is now."""
        for source in self._sources:
            yield from source()

    async def text(self) -> bytes:
        """Every family, written piece by piece, with the event loop's other work in between."""
        written = []
        for piece in pieces(self.collect()):
            written.append(piece)
            await asyncio.sleep(0)
        return "".join(written).encode()
