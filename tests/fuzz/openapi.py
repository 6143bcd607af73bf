"""Requests that the OpenAPI document allows, and ones that it does not, at a real server: answers are as it says.

    python -m tests.fuzz.openapi --minutes 10

Half of the requests name a connection and bots that there are, so that they get past the first refusal.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack
import schemathesis
import tyro
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from protocol.client import BotClient
from protocol.errors import ERRORS_BY_CODE
from server.openapi import CONNECTION_HEADER
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE, WELCOME
from tests.server.serving import serve

__all__ = ["explore"]

_CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]
_MANY_CONNECTIONS = 100_000  # a hello that is accepted leaves one


@schemathesis.serializer("application/msgpack")
def _msgpack(context: object, value: object) -> bytes:
    return msgpack.packb(value, default=str)


def explore(address: str, examples: int, draw: int) -> Counter[str]:
    """So many requests at each operation of the server at `http://host:port`, by `draw`; answers by status and code.

    Raises where an answer is a failure of the server or none that the document describes.
    """
    document = schemathesis.openapi.from_url(f"{address}/openapi.json")
    answers = Counter[str]()
    with BotClient(address) as client:
        connection, bots = client.hello().connection, client.start(2).tolist()
        for found in document.get_all_operations():
            _explore(found.ok(), connection, bots, answers, examples, draw)
    return answers


def _explore(operation: Any, connection: str, bots: list[int], answers: Counter[str], examples: int, draw: int) -> None:
    ends = operation.path.endswith(("/close", "/stop"))  # what these end, the others still need

    @seed(draw)
    @settings(max_examples=examples, database=None, deadline=None, suppress_health_check=list(HealthCheck))
    @given(case=operation.as_strategy(), known=st.booleans())
    def run(case: Any, known: bool) -> None:
        if known and not ends:
            case.headers = {**(case.headers or {}), CONNECTION_HEADER: connection}
            if isinstance(case.body, dict) and "bots" in case.body:
                case.body = {**case.body, "bots": bots}
        answered = case.call(timeout=10.0)
        answers[f"{answered.status_code} {_code(answered)}"] += 1
        case.validate_response(answered, checks=_CHECKS)
        if answered.status_code >= 400:
            assert _code(answered) in ERRORS_BY_CODE

    run()


def _code(answered: Any) -> str:
    """The error's code or the reply's type, in either format."""
    media_type = answered.headers["content-type"][0].partition(";")[0]
    if media_type not in ("application/json", "application/msgpack"):
        return media_type
    said = (msgpack.unpackb if media_type.endswith("msgpack") else json.loads)(answered.content)
    return str(said.get("code", said.get("type", "-"))) if isinstance(said, dict) else "-"


@dataclass(frozen=True)
class OpenApi:
    """Explore a server of one's own; ends with another code than 0 at the first answer that is not as documented."""

    minutes: float = 1.0
    examples: int = 200  # of each operation, again and again until the minutes are over
    seed: int = 0
    json: bool = False  # print one JSON line


def main() -> None:
    """Command line."""
    config = tyro.cli(OpenApi, description=__doc__)
    answers, begun, draw = Counter[str](), time.monotonic(), config.seed
    with tempfile.TemporaryDirectory() as name:
        bundle = make_bundle(Path(name) / "tiny", features=TABLE, action=WELCOME.action)
        with serve(bundle, Path(name) / "s", max_connections=_MANY_CONNECTIONS, max_bots=4096) as served:
            while time.monotonic() - begun < 60.0 * config.minutes:
                answers += explore(served.addresses["http"], config.examples, draw)
                draw += 1
    line = {"requests": answers.total(), "seconds": round(time.monotonic() - begun, 1), "answers": dict(answers)}
    print(json.dumps(line) if config.json else "\n".join(f"{key:>10}  {value}" for key, value in line.items()))


if __name__ == "__main__":
    main()
