"""The probes: what an orchestrator, a load balancer and Prometheus ask a server about itself, over HTTP.

This module knows nothing about messages or bots. A probe never waits for the worker: it answers when that is stuck too.
"""

from __future__ import annotations

import msgspec
from starlette.requests import Request
from starlette.responses import Response

from protocol.errors import NotReady, ProtocolError, Unauthorized
from server.exposition import CONTENT_TYPE
from server.handlers import Handlers
from server.metrics import Metrics
from server.readiness import Readiness
from server.tokens import bearer

__all__ = ["Probes", "check_bearer"]

_JSON = "application/json"


class Probes:
    """Health, readiness and metrics of one server."""

    def __init__(self, handlers: Handlers, readiness: Readiness, metrics: Metrics) -> None:
        self._handlers = handlers
        self._readiness = readiness
        self._metrics = metrics

    async def healthz(self, request: Request) -> Response:
        """The process answers."""
        return Response(b'{"status":"ok"}', media_type=_JSON)

    async def readyz(self, request: Request) -> Response:
        """A new connection would be served; where not, which checks fail and why."""
        failing = self._readiness.failing()
        checks = {name: failing.get(name, "ok") for name in self._readiness.names}
        if not failing:
            return Response(msgspec.json.encode({"status": "ready", "checks": checks}), media_type=_JSON)
        detail = "; ".join(f"{name}: {why}" for name, why in failing.items())
        body = {"type": "error", "code": NotReady.code, "detail": detail, "retry_after_s": 1.0, "checks": checks}
        return Response(msgspec.json.encode(body), NotReady.status, {"Retry-After": "1"}, _JSON)

    async def metrics(self, request: Request) -> Response:
        """Everything that is counted, for Prometheus; needs the token as `Authorization: Bearer` where there is one."""
        try:
            check_bearer(self._handlers, request)
        except ProtocolError as error:
            body = {"type": "error", "code": error.code, "detail": error.detail, "retry_after_s": None}
            return Response(msgspec.json.encode(body), error.status, media_type=_JSON)
        return Response(await self._metrics.text(), headers={"Content-Type": CONTENT_TYPE})


def check_bearer(handlers: Handlers, request: Request) -> None:
    """Raise Unauthorized unless the request carries the server's token, or it has none."""
    try:
        handlers.check_token(bearer(request.headers.get("authorization", "")))
    except Unauthorized as error:
        handlers.recorder.refused("http", error.code)
        raise
