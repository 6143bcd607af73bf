from __future__ import annotations

import json
from typing import Any

from protocol.errors import ERRORS_BY_CODE
from protocol.transport import ROUTES
from tests.server.serving import Served, http_request


def _references(value: Any) -> set[str]:
    if isinstance(value, dict):
        own = {value["$ref"]} if "$ref" in value else set()
        return own.union(*map(_references, value.values()))
    return set().union(*map(_references, value)) if isinstance(value, list) else set()


def test_the_document_describes_every_message_route_in_both_formats(served: Served) -> None:
    document = json.loads(http_request(served.addresses["http"], "GET", "/openapi.json").body)
    for path in ROUTES.values():
        operation = document["paths"][path]["post"]
        bodies = [operation["requestBody"], operation["responses"]["200"], operation["responses"]["422"]]
        assert all(set(body["content"]) == {"application/msgpack", "application/json"} for body in bodies)
        assert {str(error.status) for error in ERRORS_BY_CODE.values()} <= set(operation["responses"])
    known = {f"#/components/schemas/{name}" for name in document["components"]["schemas"]}
    assert _references(document) <= known
    assert {"post"} == document["paths"]["/v1/bundles/{name}/activate"].keys()
    assert {"/v1/bundles", "/v1/bundles/{name}/rollback", "/v1/bundle", "/v1/costs", "/healthz", "/readyz"} <= set(
        document["paths"]
    )


def test_the_documentation_page_is_served(served: Served) -> None:
    answer = http_request(served.addresses["http"], "GET", "/docs")
    assert answer.status == 200
    assert b"/openapi.json" in answer.body
