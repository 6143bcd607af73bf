"""The demo as a person runs it: its own process, a real server in another, a bundle of random weights."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from game import play as demo
from game.env import ACTION_SPEC, feature_table
from game.launcher import ServerFailed, ServerProcess
from game.play import Play, WrongBundle, play
from tests.bundles import make_bundle

ON_LINUX = sys.platform.startswith("linux")
GIVE_UP_S = 30.0


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles") / "demo-test"
    make_bundle(folder, features=feature_table(), action=ACTION_SPEC, budget=0.1, target_return=100.0)
    (folder / "full_features.json").write_text('{"return_mean": 93.5}')
    return folder


@pytest.fixture
def short(bundle: Path, tmp_path: Path) -> Play:
    return Play(
        bundle=bundle, bots=2, episodes=3, socket_episodes=1, max_decisions=25, picture=tmp_path / "new" / "demo.png"
    )


def arguments(config: Play) -> list[str]:
    return [
        "--bundle", str(config.bundle), "--bots", str(config.bots), "--episodes", str(config.episodes),
        "--socket-episodes", str(config.socket_episodes), "--max-decisions", str(config.max_decisions),
        "--picture", str(config.picture),
    ]  # fmt: skip


def processes_of(bundle: Path) -> list[int]:
    """Processes whose command line names this bundle: the demo and its server."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if str(bundle).encode() in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return [pid for pid in found if pid != os.getpid()]


def quiet() -> Console:
    return Console(file=io.StringIO())


def test_the_demo_ends_with_one_line_of_json_and_a_picture(short):
    command = [sys.executable, "-m", "game.play", *arguments(short), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])
    assert figures["episodes"] == 3
    assert figures["reached"] + figures["died"] + figures["timed_out"] == 3
    assert figures["return_full_features"] == 93.5
    assert figures["budget_violations"] == 0
    assert 0 < figures["largest_cost_us"] <= figures["budget_us"] == pytest.approx(49.2)
    assert 0 < figures["cost_pct"] <= 10.0
    for door in ("http", "socket"):
        assert 0 < figures["turn_us"][door]["p50"] <= figures["turn_us"][door]["p99"]
    assert short.picture.read_bytes().startswith(b"\x89PNG")
    assert "mean return" in done.stderr
    assert "Traceback" not in done.stderr
    assert processes_of(short.bundle) == []
    # The same seeds again, here, and over HTTP alone: the same episodes.
    again = play(replace(short, socket_episodes=0), quiet())
    assert again.turn_us.socket is None
    for figure in ("return_mean", "turns", "cost_pct", "largest_cost_us"):
        assert getattr(again, figure) == figures[figure]


@pytest.mark.skipif(not ON_LINUX, reason="reads /proc, and only Linux ends the server after kill -9")
@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_running(short, signal_number):
    endless = replace(short, episodes=100_000, max_decisions=5)
    command = [sys.executable, "-m", "game.play", *arguments(endless)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
        while "of 100000" not in (line := running.stdout.readline()):
            assert line, "the demo ended by itself"
        assert len(processes_of(short.bundle)) == 2
        running.send_signal(signal_number)
        rest, _ = running.communicate(timeout=GIVE_UP_S)
    if signal_number != signal.SIGKILL:
        assert running.returncode == 128 + signal_number
        assert f"stopped by {signal_number.name}" in rest
        assert processes_of(short.bundle) == []
    assert "Traceback" not in rest
    deadline = time.monotonic() + GIVE_UP_S
    while processes_of(short.bundle) and time.monotonic() < deadline:
        time.sleep(0.02)  # after kill -9 it is the kernel that ends the server, and nobody waits for it
    assert processes_of(short.bundle) == []


def test_a_running_server_is_played_against_and_left_running(short):
    with ServerProcess(short.bundle) as server:
        doors = server.addresses()
        over_http = play(replace(short, connect=doors["http"]), quiet())
        assert over_http.turn_us.socket is None
        over_both = play(replace(short, connect=doors["http"], connect_socket=doors["unix"]), quiet())
        assert over_both.turn_us.socket is not None
        assert over_both.return_mean == over_http.return_mean
        assert not server.ended


@pytest.mark.parametrize(
    ("broken", "why"),
    [
        ({"bundle": Path("no/such/bundle")}, "there is no bundle at no/such/bundle"),
        ({"connect": "http://127.0.0.1:9"}, "127.0.0.1:9"),
        ({"map": "nowhere"}, "there is no map 'nowhere'"),
    ],
)
def test_what_cannot_be_played_is_said_in_a_line(short, broken, why, monkeypatch, capsys):
    monkeypatch.setattr(demo.signal, "signal", lambda *_: None)
    monkeypatch.setattr(demo.tyro, "cli", lambda *_, **__: replace(short, **broken))
    with pytest.raises(SystemExit) as ended:
        demo.main()
    assert ended.value.code == 2
    shown = capsys.readouterr().out
    assert shown.startswith("cannot play: ")
    assert why in shown.replace("\n", " ")
    assert not short.picture.exists()


def test_a_violation_is_an_exit_code(short, monkeypatch, capsys):
    figures = play(replace(short, socket_episodes=0, episodes=1), quiet())
    monkeypatch.setattr(demo.signal, "signal", lambda *_: None)
    monkeypatch.setattr(demo.tyro, "cli", lambda *_, **__: short)
    for violations, code in ((0, 0), (1, 1)):
        monkeypatch.setattr(demo, "play", lambda *_, v=violations: replace(figures, budget_violations=v))
        with pytest.raises(SystemExit) as ended:
            demo.main()
        assert ended.value.code == code
    assert "1 of" in capsys.readouterr().out


def test_a_server_that_does_not_start_says_why(short, tmp_path):
    corrupt = tmp_path / "corrupt"
    corrupt.mkdir()
    (corrupt / "manifest.json").write_text("{}")
    with pytest.raises(ServerFailed, match=r"(?s)exit code 2.*BAD_BUNDLE"):
        play(replace(short, bundle=corrupt), quiet())


def test_a_bundle_of_another_game_is_refused(short, tmp_path):
    other = make_bundle(tmp_path / "other")
    with pytest.raises(WrongBundle, match="bundle tiny is not of this game"):
        play(replace(short, bundle=other), quiet())


@pytest.mark.parametrize(
    "wrong",
    [{"bots": 0}, {"episodes": 0}, {"socket_episodes": 24}, {"connect_socket": "tcp://h:1"}, {"connect": "h:1"}],
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=r".+"):
        Play(**wrong)
