from __future__ import annotations

from pathlib import Path

import pytest

from protocol.client import BotClient
from protocol.errors import Unauthorized
from server import brake as module
from server.brake import Brake
from tests.server.serving import FakeClock, http_request, serve

TOKEN = "the-engines-token"


def test_many_wrong_ones_in_a_while_wait_and_a_few_do_not() -> None:
    clock = FakeClock()
    brake = Brake(clock)
    assert [brake.wait_s() for _ in range(22)] == [0.0] * 20 + [1.0] * 2
    clock.now += 9.9
    assert brake.wait_s() == 1.0
    clock.now += 0.1
    assert [brake.wait_s() for _ in range(21)] == [0.0] * 20 + [1.0]


def test_at_every_door_wrong_tokens_wait_and_right_ones_do_not(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_N_FREE", 0)
    monkeypatch.setattr(module, "_WAIT_S", 3600.0)
    with serve(bundle, tmp_path / "s", token=TOKEN, drain_s=0.1) as served:
        for door in ("http", "tcp", "unix", "ws"):
            with BotClient(served.addresses[door], timeout_s=0.3) as guesser, pytest.raises(TimeoutError):
                guesser.hello(token="wrong")
            with BotClient(served.addresses[door], timeout_s=30.0) as client:
                assert client.hello(token=TOKEN).bundle == "tiny"
        with pytest.raises(TimeoutError):
            http_request(served.addresses["http"], "GET", "/metrics", timeout_s=0.3)
        right = {"Authorization": f"Bearer {TOKEN}"}
        assert http_request(served.addresses["http"], "GET", "/metrics", headers=right, timeout_s=30.0).status == 200
    monkeypatch.setattr(module, "_WAIT_S", 0.01)
    with (
        serve(bundle, tmp_path / "t", token=TOKEN) as served,
        BotClient(served.addresses["tcp"], timeout_s=30.0) as client,
    ):
        with pytest.raises(Unauthorized):
            client.hello(token="wrong")
        assert client.hello(token=TOKEN).bundle == "tiny"
