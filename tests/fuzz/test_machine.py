"""The state machine, in short; and bugs that it must find."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import Phase

from bot_runtime.bundle import Bundle
from server.connections import Connection, Connections
from tests.bundles import make_bundle
from tests.fuzz.stateful import run_machine
from tests.protocol.golden import TABLE, WELCOME

REACHED = {"welcome", "bots_started", "queries", "actions", "bots_stopped", "farewell"} | {
    "NO_CONNECTION", "NO_BOT", "TOO_MANY_CONNECTIONS", "TOO_MANY_BOTS", "STALE_FRAME", "FRAME_REUSED",
    "NO_PENDING_QUERY", "BAD_SHAPE", "NON_FINITE", "OUT_OF_RANGE",
}  # fmt: skip


@pytest.fixture
def bundle(tmp_path: Path) -> Bundle:
    return Bundle.load(make_bundle(tmp_path / "tiny", features=TABLE, action=WELCOME.action))


def test_a_server_agrees_with_the_model(bundle: Bundle) -> None:
    assert set(run_machine(bundle, 40, 40)) == REACHED


@pytest.mark.parametrize(
    ("where", "what"),
    [
        ((Connection, "check_owns"), lambda *_: None),  # anybody's bots are everybody's
        ((Connections, "_is_silent"), lambda *_: False),  # silence never ends a connection
        (("bot_runtime.turns.is_retry",), lambda *_: False),  # a retry is a turn of its own
    ],
    ids=["ownership", "silence", "retries"],
)
def test_a_server_that_is_broken_does_not(
    bundle: Bundle, where: tuple[object, ...], what: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(*where, what)
    with pytest.raises(AssertionError):
        run_machine(bundle, 60, 40, phases=[Phase.generate])
