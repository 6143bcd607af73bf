"""Slow sockets, in short: each kind is closed by each door of sockets; how soon is for the benchmark to say."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.slow_clients import BOTS, KINDS, hold
from benchmarks.slow_sockets import Door, SlowSockets, measure, passed
from tests.bundles import make_bundle
from tests.server.serving import serve


@pytest.mark.parametrize("door", ["ws", "tcp", "unix"])
def test_every_kind_of_slow_socket_is_closed(tmp_path: Path, door: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.slow_clients._ASKED_A_TICK", 4000)  # nobody else is here to be slowed
    bundle = make_bundle(tmp_path / "tiny")
    with serve(bundle, tmp_path / "s", frame_deadline_s=0.2, max_bots=BOTS) as served:
        held = hold(served.addresses[door], 12, 20.0)
    assert {each.kind for each in held} == set(KINDS)
    assert all(each.open_s is not None for each in held)


def test_sockets_that_are_not_closed_are_found(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    with serve(bundle, tmp_path / "s", frame_deadline_s=60.0, max_bots=BOTS) as served:
        held = hold(served.addresses["unix"], 4, 0.2)
    assert [each.open_s for each in held] == [None] * 4


def test_a_run_visits_every_door(tmp_path: Path) -> None:
    config = SlowSockets(
        make_bundle(tmp_path / "tiny"), 4, bots=1, rounds=2, quiet_s=0.1, deadline_s=1.0, patience_s=0.5
    )
    doors = measure(config)
    assert {"http", "ws", "tcp", "unix"} <= set(doors)
    assert all(door.sockets == 2 * 4 and door.p99_us > 0.0 for door in doors.values())


@pytest.mark.parametrize(("late", "p99_ratio", "expected"), [(0, 1.4, True), (1, 1.0, False), (0, 1.6, False)])
def test_what_passes(late: int, p99_ratio: float, expected: bool) -> None:
    assert passed(SlowSockets(), {"tcp": Door(500, {}, late, 1.0, 1.0, p99_ratio)}) is expected
