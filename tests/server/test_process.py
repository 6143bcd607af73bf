"""`python -m server` as a process: ready file, signals, exit codes, and nothing left behind."""

from __future__ import annotations

import array
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from protocol.client import BotClient
from tests.protocol.golden import TABLE
from tests.server.serving import RawStream, http_request, play

START_S = 60.0


@contextmanager
def process(bundle: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], dict[str, str]]]:
    ready = folder / "ready.json"
    command = [sys.executable, "-m", "server", "--bundle", str(bundle), "--port", "0", "--tcp-port", "0"]
    command += ["--uds", str(folder / "s"), "--ready-file", str(ready)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        try:
            give_up = time.monotonic() + START_S
            while not ready.exists():
                assert running.poll() is None, running.communicate()[1]
                assert time.monotonic() < give_up
                time.sleep(0.01)
            yield running, json.loads(ready.read_text())
        finally:
            running.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_with_0_and_nothing_left(bundle: Path, tmp_path: Path, number: signal.Signals) -> None:
    with process(bundle, tmp_path) as (server, addresses):
        assert addresses["pid"] == server.pid
        clients = [BotClient(addresses[door]) for door in ("http", "tcp", "unix", "ws")]
        for client in clients:
            client.hello()
            play(client, TABLE, client.start(1), range(2))
        server.send_signal(number)
        out, err = server.communicate(timeout=20)
        assert server.returncode == 0, err
        assert out == ""
        assert "Traceback" not in err
        assert os.listdir(tmp_path) == []
        for client in clients:
            with pytest.raises(ConnectionError):
                client.start(1)
            client.close()


def test_it_ends_though_clients_hold_half_sent_requests(bundle: Path, tmp_path: Path) -> None:
    with process(bundle, tmp_path) as (server, addresses), RawStream(addresses["tcp"]) as half:
        half.socket.sendall(b"\0\0\0\x10half")
        with RawStream(addresses["http"].replace("http", "tcp")) as http:
            http.socket.sendall(b"POST /v1/query HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n")
            server.terminate()
            _, err = server.communicate(timeout=20)
        assert server.returncode == 0, err


def test_a_log_that_nobody_reads_stops_no_bot(bundle: Path, tmp_path: Path) -> None:
    with process(bundle, tmp_path) as (server, addresses):
        assert server.stderr is not None
        holds = fcntl.fcntl(server.stderr.fileno(), fcntl.F_SETPIPE_SZ, 4096)
        for _ in range(holds // 100):  # two lines each, until the flood is cut: 40 lines of 100 bytes and more
            with BotClient(addresses["tcp"]) as client:
                client.hello()
        with BotClient(addresses["unix"]) as client:
            client.hello()
            play(client, TABLE, client.start(2), range(20))
        server.terminate()
        assert server.wait(timeout=20) == 0
        waiting = array.array("i", [0])
        fcntl.ioctl(server.stderr.fileno(), termios.FIONREAD, waiting)
        assert waiting[0] > holds - 400  # it was full indeed


def test_health_readiness_and_the_bundle(bundle: Path, tmp_path: Path) -> None:
    with process(bundle, tmp_path) as (_, addresses):
        assert http_request(addresses["http"], "GET", "/healthz").status == 200
        assert http_request(addresses["http"], "GET", "/readyz").status == 200
        summary = json.loads(http_request(addresses["http"], "GET", "/v1/bundle").body)
        assert (summary["name"], summary["costly_features"]) == ("tiny", TABLE.n_queries)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--bundle", "nowhere"], "manifest.json cannot be opened"),
        (["--bundle", "BUNDLE", "--host", "0.0.0.0"], "without a token"),
        (["--bundle", "BUNDLE", "--uds", "no/where"], "No such file"),
    ],
)
def test_what_cannot_be_served_ends_with_2_and_says_why(bundle: Path, arguments: list[str], said: str) -> None:
    command = [sys.executable, "-m", "server", "--port", "0"]
    command += [str(bundle) if argument == "BUNDLE" else argument for argument in arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    assert said in ended.stderr


def test_a_store_whose_recorded_version_is_missing_ends_with_2(bundle: Path, tmp_path: Path) -> None:
    shutil.copytree(bundle, tmp_path / "tiny" / "1")
    (tmp_path / "tiny" / "active.json").write_text('{"active":{"version":9,"sha256":"00"},"previous":null}')
    command = [sys.executable, "-m", "server", "--port", "0", "--store", str(tmp_path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=START_S)
    assert ended.returncode == 2
    assert "no version 9 of tiny is in the store" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_door_in_use_is_not_taken_and_a_successors_is_left_alone(bundle: Path, tmp_path: Path) -> None:
    with process(bundle, tmp_path) as (first, addresses):
        command = [sys.executable, "-m", "server", "--bundle", str(bundle), "--port", "0", "--uds", str(tmp_path / "s")]
        second = subprocess.run(command, capture_output=True, text=True, timeout=START_S)
        assert second.returncode == 2
        assert "a server listens on" in second.stderr
        with BotClient(addresses["unix"]) as client:
            client.hello()
        ready = tmp_path / "ready.json"
        ready.write_text(json.dumps(json.loads(ready.read_text()) | {"pid": 1}))  # a successor's
        first.terminate()
        assert first.wait(timeout=20) == 0
        assert os.listdir(tmp_path) == ["ready.json"]


def test_a_closed_standard_error_stops_no_server(bundle: Path, tmp_path: Path) -> None:
    ready = tmp_path / "ready.json"
    command = f"exec {sys.executable} -m server --bundle {bundle} --port 0 --ready-file {ready} 2>&-"
    with subprocess.Popen(["bash", "-c", command]) as server:
        give_up = time.monotonic() + START_S
        while not ready.exists():
            assert server.poll() is None
            assert time.monotonic() < give_up
            time.sleep(0.01)
        server.terminate()
        assert server.wait(timeout=20) == 0
