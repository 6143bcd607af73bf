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
from server.listing import Activate, Listed, Rollback
from server.store import Record

__all__ = ["ADMIN_ROUTES", "CONNECTION_HEADER", "HEAD_ROUTES", "ROUTES", "document", "summary"]

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
ADMIN_ROUTES: dict[str, type[msgspec.Struct]] = {
    "/v1/bundles/{name}/activate": Activate,
    "/v1/bundles/{name}/rollback": Rollback,
}
HEAD_ROUTES = {
    "/v1/bundles/{sha256}/manifest.json": Format.JSON.value,
    "/v1/bundles/{sha256}/acquisition.onnx": "application/octet-stream",
}
_CONNECTION = {
    "name": CONNECTION_HEADER,
    "in": "header",
    "required": True,
    "description": "The `connection` of Welcome.",
    "schema": {"type": "string"},
}
_BEARER: dict[str, list[str]] = {"bearer": []}
_REF = "#/components/schemas/{name}"


def document(app: FastAPI) -> None:
    """Add the message routes and their schemas to the application's OpenAPI document."""
    draw = app.openapi

    @cache  # drawing takes milliseconds of the event loop, and anybody may ask for it
    def openapi() -> dict[str, Any]:
        drawn = draw()
        drawn["paths"].update({path: {"post": _operation(*pair)} for path, pair in ROUTES.items()})
        drawn["paths"].update(_admin_paths())
        drawn["paths"].update(_head_paths())
        components = drawn.setdefault("components", {})
        components.setdefault("schemas", {}).update(_schemas())
        components["securitySchemes"] = {"bearer": {"type": "http", "scheme": "bearer"}}
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


def _admin_paths() -> dict[str, Any]:
    """What operators ask (`server.admin`): JSON alone, with a bearer token."""
    paths: dict[str, Any] = {"/v1/bundles": {"get": _bearer_operation("Bundles", "What there is to serve.", Listed)}}
    paths["/v1/bundles"]["get"]["responses"]["200"]["content"] = _json({"type": "array", "items": _schema(Listed)})
    for path, kind in ADMIN_ROUTES.items():
        operation = _bearer_operation(kind.__name__, str(kind.__doc__), Record)
        operation["parameters"] = [_in_path("name", "A bundle's name.", "^[a-z0-9][a-z0-9_-]{0,63}$")]
        operation["requestBody"] = {"required": True, "content": _json(_schema(kind))}
        paths[path] = {"post": operation}
    return paths


def _head_paths() -> dict[str, Any]:
    """What an engine needs to run the acquisition head itself."""
    paths = {}
    for path, media_type in HEAD_ROUTES.items():
        operation = _bearer_operation("Head", "A file of a bundle in memory, to the byte.", messages.Error)
        operation["parameters"] = [_in_path("sha256", "`bundle_sha256` of Welcome or BotsStarted.", "^[0-9a-f]{64}$")]
        operation["responses"]["200"] = {"description": "The file", "content": {media_type: {"schema": {}}}}
        paths[path] = {"get": operation}
    return paths


def _bearer_operation(summary: str, description: str, reply: type[msgspec.Struct]) -> dict[str, Any]:
    statuses = sorted({error.status for error in ERRORS_BY_CODE.values()})
    refused = {
        str(status): {"description": _codes(status), "content": _json(_schema(messages.Error))} for status in statuses
    }
    answered = {"200": {"description": reply.__name__, "content": _json(_schema(reply))}}
    return {"summary": summary, "description": description, "security": [_BEARER], "responses": answered | refused}


def _in_path(name: str, description: str, pattern: str) -> dict[str, Any]:
    schema = {"type": "string", "pattern": pattern}
    return {"name": name, "in": "path", "required": True, "description": description, "schema": schema}


def _schema(kind: type[msgspec.Struct]) -> dict[str, Any]:
    return {"$ref": _REF.format(name=kind.__name__)}


def _json(schema: dict[str, Any]) -> dict[str, Any]:
    return {Format.JSON.value: {"schema": schema}}


def _schemas() -> dict[str, Any]:
    _, components = msgspec.json.schema_components(
        [kind for pair in ROUTES.values() for kind in pair] + [messages.Error, Listed, Record, *ADMIN_ROUTES.values()],
        ref_template=_REF,
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
