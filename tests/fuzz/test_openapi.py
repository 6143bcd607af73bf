"""The OpenAPI document holds for what a real server answers, in short."""

from __future__ import annotations

from pathlib import Path

from tests.bundles import make_bundle
from tests.fuzz.openapi import explore
from tests.protocol.golden import TABLE, WELCOME
from tests.server.serving import serve


def test_answers_are_as_documented(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny", features=TABLE, action=WELCOME.action)
    with serve(bundle, tmp_path / "s", max_connections=1000) as served:
        answers = explore(served.addresses["http"], 8, 0)
    assert {"200 welcome", "422 BAD_SCHEMA", "404 NO_CONNECTION", "401 UNAUTHORIZED"} <= set(answers)
