"""The HTTP door: the same messages as bodies of POST requests, msgpack or JSON by content type.

This module knows nothing about what a message does. Bodies are read under the limit and against a deadline, decoded
once on the worker's thread, and never pass through pydantic; FastAPI serves the documentation.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from functools import partial

import msgspec
from fastapi import FastAPI
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from protocol import messages
from protocol.codec import Format
from protocol.errors import (
    BadJson,
    BadMsgpack,
    InternalError,
    MethodNotAllowed,
    NoRoute,
    ProtocolError,
    TooLarge,
    UnsupportedMediaType,
)
from server.answer import Answer, Arrival, refusal
from server.desk import Desk
from server.openapi import CONNECTION_HEADER, ROUTES, document, summary
from server.probes import Probes, check_bearer
from server.worker import Worker

__all__ = ["HttpDoor", "create_app"]

_FORMATS = {form.value: form for form in Format}
_BY_STATUS: dict[int, type[ProtocolError]] = {404: NoRoute, 405: MethodNotAllowed}


class HttpDoor:
    """Answers HTTP requests."""

    def __init__(self, desk: Desk, worker: Worker, *, body_deadline_s: float) -> None:
        self._desk = desk
        self._handlers = desk.handlers
        self._worker = worker
        self._body_deadline_s = body_deadline_s

    async def exchange(self, request: Request, kind: type[messages.Request]) -> Response:
        """One message in, one message out."""
        reply_form = _accepted(request)
        try:
            form = _content_type(request)
            reply_form = reply_form or form
            body = await self._body(request, form)
            connection = None if kind is messages.Hello else request.headers.get(CONNECTION_HEADER)
            arrival = Arrival.now("http")
            answered = self._desk.ask(body, form, connection, arrival, kind=kind, reply_form=reply_form)
            return _response(answered if isinstance(answered, Answer) else await answered, reply_form)
        except ProtocolError as error:
            self._handlers.recorder.refused("http", error.code)
            return _refused(error, reply_form or Format.JSON)
        except ClientDisconnect:
            return Response(status_code=400)  # nobody is there to read it

    async def bundle(self, request: Request) -> Response:
        """What is served, without a connection; needs the token as `Authorization: Bearer` where there is one."""
        try:
            check_bearer(self._handlers, request)
            serving = await self._worker.run(partial(self._handlers.servings.named, None))
        except ProtocolError as error:
            return _refused(error, Format.JSON)
        return Response(summary(serving.manifest), media_type=Format.JSON.value)

    async def costs(self, request: Request) -> Response:
        """What acquiring costs each connected engine, as declared and as measured; needs the token as `bundle` does."""
        try:
            check_bearer(self._handlers, request)
            reports = await self._worker.run(self._handlers.costs)
        except ProtocolError as error:
            return _refused(error, Format.JSON)
        return Response(msgspec.json.encode(reports), media_type=Format.JSON.value)

    async def _body(self, request: Request, form: Format) -> bytes:
        limit = self._handlers.max_body_bytes[form]
        announced = request.headers.get("content-length", "0")
        if not announced.isdecimal() or len(announced) > 18 or int(announced) > limit:
            raise TooLarge(f"the body has {announced[:20]} bytes, the limit is {limit}")
        body = bytearray()
        try:
            async with asyncio.timeout(self._body_deadline_s):
                async for chunk in request.stream():
                    body += chunk
                    if len(body) > limit:
                        raise TooLarge(f"the body has more than the limit of {limit} bytes")
        except TimeoutError:
            truncated = BadMsgpack if form is Format.MSGPACK else BadJson
            raise truncated(f"the body did not end within {self._body_deadline_s:g} s") from None
        return bytes(body)


def create_app(door: HttpDoor, probes: Probes) -> FastAPI:
    """The application: message routes, documentation at /docs, and probes."""
    app = FastAPI(title="Budgeted bot runtime", version=str(messages.PROTOCOL_VERSION), redoc_url=None)
    for path, (kind, _) in ROUTES.items():  # starlette's own routes: FastAPI's take a third longer a request
        app.router.routes.append(Route(path, _endpoint(door, kind), methods=["POST"]))
    views = {"/v1/bundle": door.bundle, "/v1/costs": door.costs}
    views |= {"/healthz": probes.healthz, "/readyz": probes.readyz, "/metrics": probes.metrics}
    for path, view in views.items():
        app.add_api_route(path, view, methods=["GET"], response_class=Response)
    app.add_exception_handler(HTTPException, _http_refusal)
    app.add_exception_handler(Exception, _internal)
    document(app)
    return app


def _endpoint(door: HttpDoor, kind: type[messages.Request]) -> Callable[[Request], Awaitable[Response]]:
    async def exchange(request: Request) -> Response:
        return await door.exchange(request, kind)

    return exchange


async def _http_refusal(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    refused = _BY_STATUS.get(status, InternalError)(f"{request.method} {request.url.path[:200]} is not served")
    return _refused(refused, _accepted(request) or Format.JSON)


async def _internal(request: Request, error: Exception) -> Response:
    return _refused(InternalError("the server failed to answer; its log says why"), _accepted(request) or Format.JSON)


def _content_type(request: Request) -> Format:
    given = request.headers.get("content-type", "")
    form = _FORMATS.get(given.partition(";")[0].strip().lower())
    if form is None:
        raise UnsupportedMediaType(f"content type {given[:80]!r}, expected one of {', '.join(_FORMATS)}")
    return form


def _accepted(request: Request) -> Format | None:
    """The first of our two formats that the Accept header names, if any: then it decides over the request's own."""
    for part in request.headers.get("accept", "").split(","):
        form = _FORMATS.get(part.partition(";")[0].strip().lower())
        if form is not None:
            return form
    return None


def _refused(error: ProtocolError, form: Format) -> Response:
    response = _response(refusal(error, form), form)
    if isinstance(error, TooLarge | BadMsgpack | BadJson):
        response.headers["Connection"] = "close"  # part of the body may still be on its way
    return response


def _response(answered: Answer, form: Format) -> Response:
    response = Response(answered.body, answered.status, media_type=form.value)
    if isinstance(answered.reply, messages.Error) and answered.reply.retry_after_s is not None:
        response.headers["Retry-After"] = str(math.ceil(answered.reply.retry_after_s))
    return response
