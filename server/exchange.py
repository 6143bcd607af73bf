"""The message routes of the HTTP door: one message in, one out, in front of an application with everything else.

This module knows nothing about what a message does, or what else is served. It is plain ASGI: routing and request
objects of a framework take longer than a turn. Bodies are read under the limit and against a deadline.
"""

from __future__ import annotations

import asyncio
import math
from functools import partial

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from protocol import messages
from protocol.codec import Format
from protocol.errors import (
    BadJson,
    BadMsgpack,
    MethodNotAllowed,
    NoConnection,
    ProtocolError,
    TooLarge,
    Unauthorized,
    UnsupportedMediaType,
)
from server.answer import Answer, Arrival, refusal
from server.openapi import CONNECTION_HEADER, ROUTES
from server.sockets import Sockets

__all__ = ["FORMATS", "Exchange", "accepted"]

FORMATS = {form.value: form for form in Format}
_CONNECTION_HEADER = CONNECTION_HEADER.lower().encode()
_READ_HEADERS = {b"content-type", b"content-length", b"accept", _CONNECTION_HEADER}
_CONTENT_TYPES = {form: form.value.encode() for form in Format}
_Headers = dict[bytes, bytes]


class Exchange:
    """Answers POST requests to the messages' paths at the desk of these sockets; passes all others on to `rest`."""

    def __init__(self, sockets: Sockets, rest: ASGIApp, *, body_deadline_s: float) -> None:
        self._desk, self._brake, self._vigil = sockets.desk, sockets.brake, sockets.vigil
        self._rest = rest
        self._body_deadline_s = body_deadline_s
        self._kinds = {path: kind for path, (kind, _) in ROUTES.items()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """See ASGI."""
        kind = self._kinds.get(scope["path"]) if scope["type"] == "http" else None
        if kind is None:
            await self._rest(scope, receive, partial(self._send_braked, send))
            return
        headers: _Headers = {}
        for name, value in scope["headers"]:
            if name in _READ_HEADERS:
                headers.setdefault(name, value)
        reply_form = accepted(headers.get(b"accept", b""))
        may_go_on = True
        try:
            if scope["method"] != "POST":
                raise MethodNotAllowed(f"{scope['method']} {scope['path']} is not served")
            form = _content_type(headers.get(b"content-type", b""))
            reply_form = reply_form or form
            named = None if kind is messages.Hello else headers.get(_CONNECTION_HEADER)
            connection = None if named is None else named.decode("latin-1")
            body = await self._body(headers, receive, form, connection)
            if body is None:
                return  # nobody is there to read an answer
            arrival = Arrival.now("http")
            answered = self._desk.ask(body, form, connection, arrival, kind=kind, reply_form=reply_form)
            if not isinstance(answered, Answer):
                answered = await answered
        except ProtocolError as error:
            self._desk.handlers.recorder.refused("http", error.code)
            reply_form = reply_form or Format.JSON
            answered = refusal(error, reply_form)
            # Part of the body may still be on its way.
            may_go_on = not isinstance(error, TooLarge | NoConnection | BadMsgpack | BadJson)
        sending = send if answered.status == 200 else partial(self._send_braked, send)
        await _send(sending, answered, reply_form, may_go_on)
        self._vigil.begin()

    async def _send_braked(self, send: Send, message: Message) -> None:
        if message["type"] == "http.response.start" and message["status"] == Unauthorized.status:
            await asyncio.sleep(self._brake.wait_s())
        await send(message)

    async def _body(self, headers: _Headers, receive: Receive, form: Format, connection: str | None) -> bytes | None:
        """The whole body; None where the client has left. One too long of a connection that has ended: NoConnection."""
        limit = self._desk.handlers.max_bytes(connection, form)
        announced = headers.get(b"content-length", b"0")
        if not announced.isdigit() or len(announced) > 18 or int(announced) > limit:
            self._check_known(connection)
            raise TooLarge(f"the body has {announced[:20].decode('latin-1')} bytes, the limit is {limit}")
        body = bytearray()
        try:
            async with asyncio.timeout(self._body_deadline_s):
                while True:
                    message = await receive()
                    if message["type"] != "http.request":
                        return None
                    body += message["body"]
                    if len(body) > limit:
                        self._check_known(connection)
                        raise TooLarge(f"the body has more than the limit of {limit} bytes")
                    if not message.get("more_body"):
                        return bytes(body)
        except TimeoutError:
            truncated = BadMsgpack if form is Format.MSGPACK else BadJson
            raise truncated(f"the body did not end within {self._body_deadline_s:g} s") from None

    def _check_known(self, connection: str | None) -> None:
        """What is too long for a stranger need not be for an engine, which must learn that it is to say hello again."""
        if connection is not None and self._desk.handlers.connections.peek(connection) is None:
            raise NoConnection("no such connection: say hello again")


async def _send(send: Send, answered: Answer, form: Format, may_go_on: bool) -> None:
    headers = [(b"content-length", b"%d" % len(answered.body)), (b"content-type", _CONTENT_TYPES[form])]
    if isinstance(answered.reply, messages.Error) and answered.reply.retry_after_s is not None:
        headers.append((b"retry-after", b"%d" % math.ceil(answered.reply.retry_after_s)))
    if not may_go_on:
        headers.append((b"connection", b"close"))
    await send({"type": "http.response.start", "status": answered.status, "headers": headers})
    await send({"type": "http.response.body", "body": answered.body})


def _content_type(given: bytes) -> Format:
    form = _named(given)
    if form is None:
        shown = given[:80].decode("latin-1")
        raise UnsupportedMediaType(f"content type {shown!r}, expected one of {', '.join(FORMATS)}")
    return form


def accepted(header: bytes) -> Format | None:
    """The first of our two formats that an Accept header names, if any: then it decides over the request's own."""
    if header == b"*/*":
        return None
    return next((form for form in map(_named, header.split(b",")) if form is not None), None)


def _named(content_type: bytes) -> Format | None:
    return FORMATS.get(content_type.partition(b";")[0].strip().lower().decode("latin-1"))
