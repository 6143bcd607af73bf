"""What the HTTP door serves besides messages: what is served, its head, what acquiring costs, probes, documentation.

This module knows nothing about messages and how they are exchanged (`server.exchange` does).
"""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable
from functools import partial

import msgspec
from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from bot_runtime.bundle import Bundle
from protocol import messages
from protocol.codec import Format
from protocol.errors import (
    InternalError,
    MethodNotAllowed,
    NoRoute,
    ProtocolError,
)
from server.answer import refusal
from server.exchange import accepted
from server.handlers import Handlers
from server.openapi import HEAD_ROUTES, document, summary
from server.probes import Probes, check_bearer
from server.worker import Worker

__all__ = ["HttpDoor", "create_app"]

_PIECE_BYTES = 65536
_PROBES = ("/healthz", "/readyz")  # load balancers may ask by HEAD
_BY_STATUS: dict[int, type[ProtocolError]] = {404: NoRoute, 405: MethodNotAllowed}


class HttpDoor:
    """Answers GET requests of engines, and those that nothing is served for."""

    def __init__(self, handlers: Handlers, worker: Worker) -> None:
        self._handlers = handlers
        self._worker = worker

    async def bundle(self, request: Request) -> Response:
        """What is served, or of several what `?name=` says, without a connection; needs the token as
        `Authorization: Bearer` where there is one."""
        try:
            check_bearer(self._handlers, request)
            name = request.query_params.get("name")
            serving = await self._worker.run(partial(self._handlers.servings.named, name))
        except ProtocolError as error:
            return _refused(error, Format.JSON)
        return Response(summary(serving.manifest), media_type=Format.JSON.value)

    async def manifest(self, request: Request) -> Response:
        """`manifest.json` of the bundle with the hash in the path, to the byte; needs the token as `bundle` does."""
        return await self._file(request, lambda bundle: bundle.manifest_json, Format.JSON.value)

    async def acquisition(self, request: Request) -> Response:
        """`acquisition.onnx` of the same, for an engine that runs the head itself."""
        return await self._file(request, lambda bundle: bundle.acquisition, "application/octet-stream")

    async def _file(self, request: Request, part: Callable[[Bundle], bytes], media_type: str) -> Response:
        try:
            check_bearer(self._handlers, request)
            serving = await self._worker.run(partial(self._handlers.servings.of, request.path_params["sha256"]))
        except ProtocolError as error:
            return _refused(error, Format.JSON)
        content = part(serving.bots.bundle)
        # What a hash names never changes.
        headers = {"Content-Length": str(len(content)), "Cache-Control": "private, max-age=31536000, immutable"}
        return StreamingResponse(_pieces(content), headers=headers, media_type=media_type)

    async def not_served(self, request: Request, error: Exception) -> Response:
        """Count what nothing is served for, and say so."""
        status = error.status_code if isinstance(error, HTTPException) else 500
        refused = _BY_STATUS.get(status, InternalError)(f"{request.method} {request.url.path[:200]} is not served")
        self._handlers.recorder.refused("http", refused.code)
        return _refused(refused, _accepted(request))

    async def costs(self, request: Request) -> Response:
        """What acquiring costs each connected engine, as declared and as measured; needs the token as `bundle` does."""
        try:
            check_bearer(self._handlers, request)
            reports = await self._worker.run(self._handlers.costs)
        except ProtocolError as error:
            return _refused(error, Format.JSON)
        return Response(msgspec.json.encode(reports), media_type=Format.JSON.value)


def create_app(door: HttpDoor, probes: Probes) -> FastAPI:
    """The application: probes, and documentation at /docs of these and of the message routes."""
    version = str(messages.PROTOCOL_VERSION)
    app = FastAPI(title="Budgeted bot runtime", version=version, redoc_url=None, redirect_slashes=False)
    views = {"/v1/bundle": door.bundle, "/v1/costs": door.costs}
    views |= dict(zip(HEAD_ROUTES, (door.manifest, door.acquisition), strict=True))
    views |= {"/healthz": probes.healthz, "/readyz": probes.readyz, "/metrics": probes.metrics}
    for path, view in views.items():
        app.add_api_route(path, view, methods=["GET"], response_class=Response)
    for path in _PROBES:
        app.add_api_route(path, views[path], methods=["HEAD"], response_class=Response, include_in_schema=False)
    app.add_exception_handler(HTTPException, door.not_served)
    app.add_exception_handler(Exception, _internal)
    document(app)
    return app


async def _pieces(content: bytes) -> AsyncIterator[memoryview]:
    """So that no more than one piece is copied for a client that reads slowly."""
    for start in range(0, len(content), _PIECE_BYTES):
        yield memoryview(content)[start : start + _PIECE_BYTES]


async def _internal(request: Request, error: Exception) -> Response:
    return _refused(InternalError("the server failed to answer; its log says why"), _accepted(request))


def _refused(error: ProtocolError, form: Format) -> Response:
    answered = refusal(error, form)
    headers = {} if error.retry_after_s is None else {"Retry-After": str(math.ceil(error.retry_after_s))}
    return Response(answered.body, answered.status, headers, media_type=form.value)


def _accepted(request: Request) -> Format:
    return accepted(request.headers.get("accept", "").encode("latin-1")) or Format.JSON
