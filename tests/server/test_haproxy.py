"""Two real servers behind a real HAProxy, as it is shipped: a bot always reaches the process that holds it.

Skipped where HAProxy is not installed.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import msgpack
import numpy as np
import pytest

from benchmarks.front import CONFIG, Front, configured
from game.launcher import ServerProcess
from protocol.client import Actions, BotClient
from protocol.errors import NoConnection
from protocol.features import FeatureTable
from tests.bundles import make_bundle
from tests.server.serving import play, same

pytestmark = pytest.mark.skipif(shutil.which("haproxy") is None, reason="haproxy is not installed")

N_BOTS = 2
WAIT_S = 60.0
"""For anything that a process does: these tests must not fail because a machine is busy."""
PATIENT = ("--frame-deadline-s", "60", "--stuck-after-s", "60", "--drain-s", "0.5")


class Behind(NamedTuple):
    front: Front
    servers: list[ServerProcess]


@pytest.fixture
def behind(tmp_path: Path) -> Iterator[Behind]:
    """p1 and p2 behind HAProxy."""
    bundle = make_bundle(tmp_path / "tiny")
    with ExitStack() as stack:
        servers = [
            stack.enter_context(ServerProcess(bundle, "--tcp-port", "0", "--process", name, *PATIENT))
            for name in ("p1", "p2")
        ]
        addresses = [server.addresses() for server in servers]
        yield Behind(stack.enter_context(Front(addresses, is_patient=True)), servers)


class Engine(NamedTuple):
    client: BotClient
    table: FeatureTable
    bots: np.ndarray

    def play(self, frame: int) -> list[Actions]:
        return play(self.client, self.table, self.bots, range(frame, frame + 1))


def engine_of(client: BotClient) -> tuple[str, Engine]:
    """Say hello, start bots; the process that holds them is the beginning of the connection's name."""
    welcome = client.hello()
    bots = client.start(N_BOTS, seeds=[7, 8])
    return welcome.connection.partition("-")[0], Engine(client, welcome.features, bots)


def connect(url: str, stack: ExitStack) -> dict[str, Engine]:
    """An engine in each process, all through the front."""
    engines: dict[str, Engine] = {}
    given_up_s = time.monotonic() + WAIT_S
    while set(engines) != {"p1", "p2"}:
        assert time.monotonic() < given_up_s, f"connections are not spread: {set(engines)}"
        client = BotClient(url, timeout_s=WAIT_S)
        process, engine = engine_of(client)
        if process in engines:
            client.close()
        else:
            engines[process] = Engine(stack.enter_context(client), engine.table, engine.bots)
    return engines


def test_the_shipped_configuration_is_valid() -> None:
    done = subprocess.run(["haproxy", "-c", "-f", str(CONFIG)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr.lower()


def test_a_front_is_configured_as_shipped_but_for_servers_and_ports() -> None:
    shipped = CONFIG.read_text(encoding="utf-8")
    two = [{"http": f"http://127.0.0.1:800{n}", "tcp": f"tcp://127.0.0.1:900{n}"} for n in (1, 2)]
    assert configured(shipped, two, 8000, 9000) == shipped
    three = [*two, {"http": "http://127.0.0.1:7003", "tcp": "tcp://127.0.0.1:7103"}]
    added = set(configured(shipped, three, 8000, 9000).splitlines()) - set(shipped.splitlines())
    assert added == {"    server p3 127.0.0.1:7003", "    server p3 127.0.0.1:7103 port 7003"}


@pytest.mark.parametrize("door", ["http", "tcp"])
def test_bots_play_on_in_the_process_that_holds_them(behind: Behind, door: str) -> None:
    """Frame by frame in turn: a request that strayed would get NO_CONNECTION."""
    with ExitStack() as stack:
        engines = connect(getattr(behind.front, door), stack)
        played: dict[str, list[Actions]] = {process: [] for process in engines}
        for frame in range(12):
            for process, engine in engines.items():
                played[process] += engine.play(frame)
    assert same(played["p1"], played["p2"]), "the same seeds and numbers give the same actions in any process"


def test_a_connection_of_no_process_is_refused_by_one_that_does_not_know_it(behind: Behind) -> None:
    for name in ("p9-" + "0" * 32, "p1-" + "0" * 32, "0" * 32, "p1"):
        request = Request(behind.front.http + "/v1/bots/stop", b"\x82\xa4type\xa9stop_bots\xa4bots\x91\x01")
        request.add_header("Content-Type", "application/msgpack")
        request.add_header("X-Bot-Connection", name)
        with pytest.raises(HTTPError) as refused:
            urlopen(request, timeout=WAIT_S)
        with refused.value as answer:
            assert msgpack.unpackb(answer.read())["code"] == "NO_CONNECTION"


@pytest.mark.parametrize("door", ["http", "tcp"])
def test_losing_a_process_loses_its_connections_alone(behind: Behind, door: str) -> None:
    with ExitStack() as stack:
        engines = connect(getattr(behind.front, door), stack)
        for engine in engines.values():
            engine.play(0)
        os.kill(behind.servers[0].pid, signal.SIGKILL)
        os.waitid(os.P_PID, behind.servers[0].pid, os.WEXITED | os.WNOWAIT)  # a process that is dying may still accept
        engines["p2"].play(1)
        with pytest.raises(NoConnection if door == "http" else OSError):
            engines["p1"].play(1)
        engines["p2"].play(2)
        process, resumed = engine_of(engines["p1"].client)
        assert process == "p2"
        for frame in range(3, 9):
            assert same(resumed.play(frame - 3), resumed.play(frame - 3)), "a turn and its retry"
            engines["p2"].play(frame)
