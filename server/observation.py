"""Observation: which parts of a server are watched, by readiness checks and by metrics.

This module knows nothing about how any of it is asked for. Everything here is read on the event loop, while the worker
may be at work: single numbers, or containers copied in one go.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

from prometheus_client.metrics_core import Metric

from server import families
from server.connections import Connections
from server.crowd import Crowd
from server.handlers import Handlers
from server.metrics import Metrics
from server.readiness import Readiness
from server.settings import Settings
from server.sockets import Sockets
from server.worker import Worker

__all__ = ["Observation", "watch"]


class Observation(NamedTuple):
    """Whether the server is ready, and what it has counted."""

    readiness: Readiness
    metrics: Metrics


def watch(
    settings: Settings, handlers: Handlers, connections: Connections, worker: Worker, sockets: Sockets, crowd: Crowd
) -> Observation:
    """What every server is asked about; whoever assembles it may register more."""
    readiness, metrics = Readiness(), Metrics()
    readiness.register("bundle", partial(_no_bundle, handlers))
    readiness.register("breaker", partial(_too_slow, handlers))
    readiness.register("worker", partial(_stuck, worker.busy_s, settings.stuck_after_s))
    metrics.register(partial(families.requests, handlers.recorder))
    metrics.register(lambda: families.bundles(handlers.servings))
    metrics.register(partial(_saturation, settings, connections, worker, sockets))
    metrics.register(partial(families.deadlines, sockets.desk.due))
    metrics.register(lambda: families.sockets(_by_transport(sockets, crowd)))
    metrics.register(lambda: families.readiness(readiness.names, readiness.failing()))
    return Observation(readiness, metrics)


def _no_bundle(handlers: Handlers) -> str | None:
    return None if any(True for _ in handlers.servings) else "no bundle is served"


def _too_slow(handlers: Handlers) -> str | None:
    open_breakers = handlers.servings.open_breakers()
    return f"too slow, so falling back: {', '.join(open_breakers)}" if open_breakers else None


def _stuck(busy_s: Callable[[], float], stuck_after_s: float) -> str | None:
    since_s = busy_s()
    return None if since_s <= stuck_after_s else f"what runs now began {since_s:.1f} s ago and has not ended"


def _by_transport(sockets: Sockets, crowd: Crowd) -> dict[str, int]:
    """How many sockets are open; those of the HTTP port that are no WebSockets are `http`."""
    counted = sockets.by_transport()
    return {**counted, "http": len(crowd) - counted.get("ws", 0)}


def _saturation(settings: Settings, connections: Connections, worker: Worker, sockets: Sockets) -> Iterator[Metric]:
    """How full the server is, each number beside its limit."""
    n_waiting = worker.n_waiting + len(sockets.desk.looks)
    for name, help_text, number in (
        ("bots_limit", "Bots that fit, of all bundles.", settings.max_bots),
        ("connections", "Connections.", len(connections)),
        ("connections_limit", "Connections that fit.", settings.max_connections),
        ("http_sockets_limit", "Sockets that the HTTP port may have, WebSockets included.", settings.http_sockets),
        ("queue_length", "Requests that wait, with the one that the worker answers.", n_waiting),
        ("queue_limit", "Requests that may wait.", worker.max_queue),
        (
            "worker_busy_seconds",
            "How long ago what the worker does now began; 0: nothing.",
            worker.busy_s(),
        ),
    ):
        yield families.gauge(name, help_text, (), {(): float(number)})
