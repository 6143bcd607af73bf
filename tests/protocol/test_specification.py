"""PROTOCOL.md says what the code does, where a machine can tell."""

from __future__ import annotations

import re
from pathlib import Path

import protocol
from protocol.codec import Format, body_limit
from protocol.errors import ERRORS_BY_CODE
from protocol.messages import Reply, Request
from protocol.transport import ROUTES
from tests.protocol.golden import TABLE

TEXT = (Path(protocol.__path__[0]) / "PROTOCOL.md").read_text("utf-8")


def test_the_error_table_is_the_tree() -> None:
    written = {code: int(status) for code, status in re.findall(r"^\| `([A-Z_]+)` \| (\d{3}) \|", TEXT, re.MULTILINE)}
    assert written == {code: error.status for code, error in ERRORS_BY_CODE.items()}


def test_every_field_of_every_message_is_named() -> None:
    for message in (*Request.__args__, *Reply.__args__):
        assert message.__struct_config__.tag in TEXT
        for field in message.__struct_fields__:
            assert re.search(rf"\| {field} \||`{field}`", TEXT), f"{message.__name__}.{field}"


def test_every_route_is_named_with_its_request() -> None:
    for kind, path in ROUTES.items():
        assert f"| POST {path} | `{kind}` |" in TEXT


def test_the_limit_is_the_formula() -> None:
    f, m, d = TABLE.n_free, TABLE.n_queries, TABLE.n_costly
    assert "16,384 + b·M + max_bots · (37 + max(b·(F + D + 4) + 4·M, 5·b)) with b = 9 in msgpack and 26 in JSON" in TEXT
    for form, b in ((Format.MSGPACK, 9), (Format.JSON, 26)):
        assert body_limit(TABLE, 8, form) == 16384 + b * m + 8 * (37 + max(b * (f + d + 4) + 4 * m, 5 * b))
