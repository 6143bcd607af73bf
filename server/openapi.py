"""What the HTTP door's documentation says: routes, schemas of both content types, statuses, and the bundle's summary.

This module knows nothing about requests being served.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec
from fastapi import FastAPI

from bot_runtime.manifest import Manifest
from protocol import messages
from protocol.codec import Format
from protocol.errors import ERRORS_BY_CODE

__all__ = ["CONNECTION_HEADER", "ROUTES", "document", "summary"]

CONNECTION_HEADER = "X-Bot-Connection"
ROUTES: dict[str, tuple[type[messages.Request], type[messages.Reply]]] = {
    "/v1/connections": (messages.Hello, messages.Welcome),
    "/v1/bots/start": (messages.StartBots, messages.BotsStarted),
    "/v1/query": (messages.RequestQueries, messages.Queries),
    "/v1/act": (messages.SubmitFeatures, messages.Actions),
    "/v1/turn": (messages.TakeTurn, messages.Actions),
    "/v1/bots/stop": (messages.StopBots, messages.BotsStopped),
    "/v1/connections/close": (messages.Goodbye, messages.Farewell),
}
_CONNECTION = {
    "name": CONNECTION_HEADER,
    "in": "header",
    "required": True,
    "description": "The `connection` of Welcome.",
    "schema": {"type": "string"},
}
_REF = "#/components/schemas/{name}"


def document(app: FastAPI) -> None:
    """Add the message routes and their schemas to the application's OpenAPI document."""
    draw = app.openapi

    @cache  # drawing takes milliseconds of the event loop, and anybody may ask for it
    def openapi() -> dict[str, Any]:
        drawn = draw()
        drawn["paths"].update({path: {"post": _operation(*pair)} for path, pair in ROUTES.items()})
        drawn.setdefault("components", {}).setdefault("schemas", {}).update(_schemas())
        return drawn

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the document


def _operation(request: type[messages.Request], reply: type[messages.Reply]) -> dict[str, Any]:
    statuses = sorted({error.status for error in ERRORS_BY_CODE.values()})
    return {
        "summary": request.__name__,
        "description": request.__doc__,
        "parameters": [] if request is messages.Hello else [_CONNECTION],
        "requestBody": {"required": True, "content": _content(request)},
        "responses": {
            "200": {"description": reply.__name__, "content": _content(reply)},
            **{
                str(status): {"description": _codes(status), "content": _content(messages.Error)} for status in statuses
            },
        },
    }


def _schemas() -> dict[str, Any]:
    _, components = msgspec.json.schema_components(
        [kind for pair in ROUTES.values() for kind in pair] + [messages.Error], ref_template=_REF
    )
    return components


def summary(manifest: Manifest) -> bytes:
    """What /v1/bundle answers: JSON of what a person or a dashboard wants to know about the bundle."""
    return msgspec.json.encode(
        {
            "name": manifest.name,
            "method": manifest.method,
            "context_length": manifest.context_length,
            "target_return": manifest.target_return,
            "budget": manifest.budget,
            "budget_us": manifest.budget_us,
            "target_cost": manifest.target_cost,
            "full_cost_us": float(manifest.features.costs_us.sum()),
            "free_numbers": manifest.features.n_free,
            "costly_features": manifest.features.n_queries,
            "costly_numbers": manifest.features.n_costly,
            "action": manifest.action,
            "features": manifest.features,
            "provenance": manifest.provenance,
        }
    )


def _content(kind: type[msgspec.Struct]) -> dict[str, Any]:
    schema = {"$ref": _REF.format(name=kind.__name__)}
    return {form.value: {"schema": schema} for form in Format}


def _codes(status: int) -> str:
    return ", ".join(sorted(error.code for error in ERRORS_BY_CODE.values() if error.status == status))
