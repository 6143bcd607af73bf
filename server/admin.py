"""What operators ask of a running server: which bundles there are, which version of one is to be active.

This module knows nothing about how a version becomes active. Everything is JSON; the token comes as
`Authorization: Bearer`, and without an admin token in the settings nobody can change anything.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TypeVar

import msgspec
from fastapi import FastAPI
from msgspec import Struct
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from protocol import codec
from protocol.codec import Format
from protocol.errors import (
    BadJson,
    InternalError,
    NoBundle,
    ProtocolError,
    TooLarge,
    Unauthorized,
    UnsupportedMediaType,
)
from server.answer import refusal
from server.catalogue import Catalogue
from server.handlers import Handlers
from server.listing import Activate, Rollback, in_memory, listing
from server.logs import logger
from server.openapi import ADMIN_ROUTES
from server.store import Record
from server.tokens import bearer, check
from server.worker import Worker

__all__ = ["AdminDoor", "add_routes"]

_MAX_BODY_BYTES = 4096
_JSON = Format.JSON.value
_log = logger(__name__)
T = TypeVar("T", bound=Struct)


class AdminDoor:
    """`catalogue` is None where one folder is served: it is listed, and cannot be exchanged."""

    def __init__(
        self,
        handlers: Handlers,
        worker: Worker,
        catalogue: Catalogue | None,
        *,
        admin_token: str | None,
        body_deadline_s: float,
    ) -> None:
        self._handlers = handlers
        self._worker = worker
        self._catalogue = catalogue
        self._admin_token = admin_token
        self._body_deadline_s = body_deadline_s

    async def bundles(self, request: Request) -> bytes:
        """Everything that there is to serve; needs the server's token, if it has one, or the admin token."""
        given = bearer(request.headers.get("authorization", ""))
        try:
            self._handlers.check_token(given)
        except Unauthorized:
            self._check_admin(given)
        store = None if self._catalogue is None else self._catalogue.store
        loaded = await self._worker.run(partial(in_memory, self._handlers.servings))
        return msgspec.json.encode(await asyncio.to_thread(listing, loaded, store))

    async def activate(self, request: Request) -> bytes:
        """Make a version active; see `Catalogue.activate`."""
        catalogue, asked = await self._asked(request, Activate)
        return _encoded(await catalogue.activate(request.path_params["name"], asked.version, asked.sha256))

    async def rollback(self, request: Request) -> bytes:
        """Make the version before active; see `Catalogue.rollback`."""
        catalogue, _ = await self._asked(request, Rollback)
        return _encoded(await catalogue.rollback(request.path_params["name"]))

    def refused(self, request: Request, error: ProtocolError) -> None:
        """Count it, and say so: whoever guesses tokens here wants more than a bot."""
        self._handlers.recorder.refused("http", error.code)
        _log.warning("operator refused", path=request.url.path[:200], code=error.code)

    async def _asked(self, request: Request, kind: type[T]) -> tuple[Catalogue, T]:
        self._check_admin(bearer(request.headers.get("authorization", "")))
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
            raise UnsupportedMediaType(f"expected content type {_JSON}")
        asked = codec.decode(await self._body(request), Format.JSON, kind)
        if self._catalogue is None:
            raise NoBundle("this server serves one folder: it has no store of versions")
        return self._catalogue, asked

    async def _body(self, request: Request) -> bytes:
        body = bytearray()
        try:
            async with asyncio.timeout(self._body_deadline_s):
                async for chunk in request.stream():
                    body += chunk
                    if len(body) > _MAX_BODY_BYTES:
                        raise TooLarge(f"the body has more than the limit of {_MAX_BODY_BYTES} bytes")
        except TimeoutError:
            raise BadJson(f"the body did not end within {self._body_deadline_s:g} s") from None
        return bytes(body)

    def _check_admin(self, given: str | None) -> None:
        if self._admin_token is None:
            raise Unauthorized("no admin token is set: nothing can be changed here")
        check(given, self._admin_token)


def add_routes(app: FastAPI, door: AdminDoor) -> None:
    """Add the routes of operators to the application."""
    routes = {"/v1/bundles": (door.bundles, "GET")}
    routes |= {path: (getattr(door, path.rpartition("/")[2]), "POST") for path in ADMIN_ROUTES}
    for path, (exchange, method) in routes.items():
        app.router.routes.append(Route(path, partial(_answer, door, exchange), methods=[method]))


async def _answer(door: AdminDoor, exchange: Callable[[Request], Awaitable[bytes]], request: Request) -> Response:
    try:
        return Response(await exchange(request), media_type=_JSON)
    except ProtocolError as error:
        door.refused(request, error)
        return _refused(error)
    except ClientDisconnect:
        return Response(status_code=400)  # nobody is there to read it
    except OSError:
        _log.exception("the store cannot be used")
        return _refused(InternalError("the store cannot be used; the server's log says why"))


def _encoded(record: Record) -> bytes:
    return msgspec.json.encode(record)


def _refused(error: ProtocolError) -> Response:
    refused = refusal(error, Format.JSON)
    headers = {} if error.retry_after_s is None else {"Retry-After": str(math.ceil(error.retry_after_s))}
    if isinstance(error, TooLarge | BadJson):
        headers["Connection"] = "close"  # part of the body may still be on its way
    return Response(refused.body, refused.status, headers, media_type=_JSON)
