"""clients/godot against a real server, a fake one and the golden frames: one run of the engine does it all.

A scenario goes to `godot/runner.gd` as JSON and what came of it comes back; each test looks at its part.
"""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from game.env import ACTION_SPEC, feature_table
from protocol.client import BotClient
from protocol.replies import read_actions, read_bots_started, read_queries, read_reply, read_welcome
from tests.bundles import make_bundle
from tests.clients.fake_server import Conversation, answering
from tests.clients.godot_cases import (
    CLASSES,
    GOOD,
    HOSTILE,
    RAYS,
    SAID,
    answer_to,
    b64,
    codec_cases,
    rays_scenario,
    read_cases,
    readable,
    sayable,
    shown,
    wrong_replies,
)
from tests.protocol.golden import BOTS, REFUSED, REPLIES, REQUESTS, TABLE, VECTORS, WELCOME
from tests.server.serving import costly_numbers, free_numbers, serve

ROOT = Path(__file__).resolve().parents[2]
GODOT = shutil.which("godot3-server")
pytestmark = pytest.mark.skipif(GODOT is None, reason="needs Godot 3 without a display: no godot3-server here")

SEEDS = [3, 2**63 - 1, 5, 7, 11]
BUDGETS_US = [98.4, 98.4, 40.0, 5.0, 0.0]
FRAMES, ERRORS_AT, FAILS_AT = range(2, 26, 2), 8, {12, 14}


def godot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """One run of the engine, whose own files go to `folder`."""
    home = {"HOME": str(folder), "XDG_DATA_HOME": str(folder), "LC_ALL": "C.UTF-8", "PATH": os.environ["PATH"]}
    command = [str(GODOT), "--path", str(ROOT / "clients" / "godot"), *arguments]
    return subprocess.run(command, env=home, capture_output=True, text=True, timeout=30, check=False)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The TCP address of a real server."""
    folder = tmp_path_factory.mktemp("served")
    bundle = make_bundle(folder / "tiny", features=feature_table(), action=ACTION_SPEC, budget=0.2)
    with serve(bundle, folder / "s") as served:
        yield served.addresses["tcp"]


def play_scenario(address: str) -> dict[str, Any]:
    with BotClient(address) as client:
        table, n = client.hello().features, len(SEEDS)
    frames = [
        {
            "frame": frame,
            "free": b64(free_numbers(table, n, frame).tobytes()),
            "costly": b64(costly_numbers(table, n, frame).tobytes()),
            "fails": frame in FAILS_AT,
        }
        for frame in FRAMES
    ]
    seeds = [str(seed) for seed in SEEDS]
    return {"count": n, "seeds": seeds, "budgets_us": BUDGETS_US, "errors_at": ERRORS_AT, "frames": frames}


def loop_of_the_readme(address: str) -> str:
    (code,) = re.findall(r"```gdscript\n(.*?)```", (ROOT / "clients" / "godot" / "README.md").read_text("utf-8"), re.S)
    assert code.count("7777") == 1
    return str(code.replace("7777", address.rpartition(":")[2]))


@pytest.fixture(scope="module")
def run(served: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Everything in one run of the engine: what the runner saw, and what the fake server was asked."""
    folder = tmp_path_factory.mktemp("godot")
    hostile = [{"query": len(said.answers) > 1, "timeout_s": 5 if code != "TIMED_OUT" else 0.2}
               for said, (code, *_) in HOSTILE.values()]  # fmt: skip
    with (
        socket.socket() as unheard,  # bound and not listening
        answering([conversation for conversation, _ in HOSTILE.values()]) as bad,
        answering([Conversation([answer_to(name) for name in SAID])]) as golden,
    ):
        unheard.bind(("127.0.0.1", 0))
        scenario = {
            "codec": [b64(body) for body in codec_cases()],
            "read": read_cases(),
            "closed_port": unheard.getsockname()[1],
            "hostile": {"port": bad.port, "cases": hostile},
            "said": {"port": golden.port, "messages": [sayable(name) for name in SAID]},
            "play": {"port": int(served.rpartition(":")[2]), **play_scenario(served)},
            "rays": rays_scenario(),
            "loop": loop_of_the_readme(served),
        }
        (folder / "scenario.json").write_text(json.dumps(scenario), encoding="utf-8")
        runner = str(Path(__file__).parent / "godot" / "runner.gd")
        finished = godot(folder, "-s", runner, f"--scenario={folder}/scenario.json", f"--out={folder}/out.json")
    assert "SCRIPT ERROR" not in finished.stderr, finished.stderr
    assert finished.returncode == 0, finished.stderr
    seen: dict[str, list[Any]] = {"asked": golden.asked}
    for line in (folder / "out.json").read_text("utf-8").splitlines():
        part, result = json.loads(line)
        seen.setdefault(part, []).append(result)
    return {part: each[0] if part in ("refused_here", "play", "rays", "loop") else each for part, each in seen.items()}


def test_msgpack_reads_what_the_package_reads_and_refuses_what_it_refuses(run: dict[str, Any]) -> None:
    cases = codec_cases()
    assert len(run["codec"]) == len(cases)
    verdicts = set()
    for body, seen in zip(cases, run["codec"], strict=True):
        fits, value = readable(body)
        assert ("shown" in seen) == fits, (body[:80], seen)
        assert not fits or seen["shown"] == shown(value)
        verdicts.add(fits)
    assert verdicts == {True, False}


def test_msgpack_writes_golden_frames_byte_for_byte(run: dict[str, Any]) -> None:
    seen = dict(zip(codec_cases(), run["codec"], strict=True))
    for vector in [*REQUESTS, *REPLIES]:
        assert seen[vector.body]["again"] == vector.body.hex(), vector.name
    for vector in REFUSED:
        if vector.description["refused_with"] in ("BAD_MSGPACK", "TOO_DEEP"):
            assert "fault" in seen[vector.body], vector.name


def test_the_client_says_golden_requests_byte_for_byte(run: dict[str, Any]) -> None:
    assert run["said"] == ["OK"] * (1 + len(SAID))
    for name, body in zip(SAID, run["asked"], strict=True):
        assert body == VECTORS[name].body, name


def test_replies_that_the_protocol_does_not_allow_are_errors(run: dict[str, Any]) -> None:
    good, wrong = len(GOOD), len(wrong_replies())
    assert all(result["ok"] for result in run["read"][:good]), run["read"][:good]
    assert [result["code"] for result in run["read"][good : good + wrong]] == ["BAD_REPLY"] * wrong
    verdicts = set()
    for case, result in zip(read_cases()[good + wrong :], run["read"][good + wrong :], strict=True):
        if result["ok"]:
            read_by_python(case["message"]["type"], base64.b64decode(case["body"]))  # whatever it accepts, so must we
        verdicts.add(result["ok"])
    assert verdicts == {True, False}  # changed at random, and no crash


def read_by_python(asked: str, body: bytes) -> None:
    reply = read_reply(body, asked)
    match asked:
        case "hello":
            read_welcome(reply)
        case "start_bots":
            read_bots_started(reply, read_welcome(read_reply(VECTORS["welcome"].body, "hello")), len(BOTS))
        case "request_queries":
            read_queries(reply, len(BOTS), TABLE)
        case "submit_features":
            read_actions({**reply, "hidden": None}, len(BOTS), WELCOME.action)  # which this client does not ask for


def test_a_bad_server_is_an_error_and_never_a_hang(run: dict[str, Any]) -> None:
    seen = dict(zip(HOSTILE, run["hostile"], strict=True))
    for name, (_, expected) in HOSTILE.items():
        assert (seen[name]["code"], seen[name]["retry_after_s"], seen[name]["is_open"]) == expected, name
    assert (seen["late"]["late"], seen["late"]["n_late"]) == (True, 1)


def test_what_cannot_be_sent_is_an_error_too(run: dict[str, Any]) -> None:
    codes = {"no_hello": "NO_CONNECTION", "no_socket": "CONNECTION_LOST", "poll": None}
    assert run["refused_here"] == {**codes, "closed_port": "CONNECT_FAILED", "no_port": "CONNECT_FAILED"}


def test_errors_have_the_servers_codes_and_retries_the_same_answer(run: dict[str, Any]) -> None:
    codes = ["NO_BOT", "STALE_FRAME", "FRAME_REUSED", "OUT_OF_RANGE", "BAD_SHAPE", "BAD_SCHEMA"]
    codes += ["NO_PENDING_QUERY", "MISSING_FEATURE", "BAD_SHAPE", "TOO_MANY_BOTS", "BAD_SHAPE"]
    assert run["play"]["errors"] == [*codes, True, True, len(SEEDS)]


def test_queries_and_actions_are_those_of_the_python_client_bit_for_bit(run: dict[str, Any], served: str) -> None:
    """In spite of every error in between; the same seeds and numbers on another connection."""
    n, asked = len(SEEDS), 0
    with BotClient(served) as client:
        table = client.hello().features
        bots = client.start(n, seeds=SEEDS, budgets_us=BUDGETS_US)
        for frame, seen in zip(FRAMES, run["play"]["frames"], strict=True):
            queries = client.query(bots, frame, free_numbers(table, n, frame), np.full(n, 0.25))
            failed = np.zeros_like(queries.queries)
            if frame in FAILS_AT:
                first = queries.queries.argmax(axis=1)
                failed[np.arange(n), first] = queries.queries[np.arange(n), first]
            acquired = queries.queries & ~failed
            actions = client.act(bots, frame, acquired, costly_numbers(table, n, frame), failed)
            assert seen["asked"] == [np.flatnonzero(row).tolist() for row in queries.queries]
            assert seen["cost_us"] == shown(queries.cost_us.tolist())
            assert seen["actions"] == actions.actions.tobytes().hex()
            assert (seen["reasons"], seen["turns"]) == (actions.reasons.tolist(), actions.turns.tolist())
            asked += int(queries.queries.sum())
    assert asked > 0


def test_rays_are_cast_where_the_table_says(run: dict[str, Any]) -> None:
    rays = run["rays"]
    assert (rays["fault"], rays["ok"], rays["again"], rays["wrong_classes"]) == ("", True, True, "BAD_SHAPE")
    rows = np.array(rays["all"]).reshape(len(RAYS), 1 + len(CLASSES))
    for row, (name, (distance_m, kind)) in zip(rows, RAYS.items(), strict=True):
        assert row[0] == pytest.approx(distance_m, abs=0.05), name  # shapes have margins
        assert row[1:].tolist() == [float(each == kind) for each in CLASSES], name
    assert (rays["one"], rays["none"]) == (rows[1].tolist(), [])


def test_the_loop_of_the_readme_plays(run: dict[str, Any]) -> None:
    assert run["loop"] == {"frames": 5, "decided": 4}  # the fifth had only been asked


def test_the_demo_plays_and_says_when_it_cannot(served: str, tmp_path: Path) -> None:
    port = served.rpartition(":")[2]
    finished = godot(tmp_path, f"--port={port}", "--bots=3", "--decisions=5")
    assert (finished.returncode, "SCRIPT ERROR" in finished.stderr) == (0, False), finished.stderr
    assert "3 bots, 5 frames" in finished.stdout
    finished = godot(tmp_path, f"--port={port}", "--bots=1", "--decisions=2", "--measure=1")
    assert (finished.returncode, "SCRIPT ERROR" in finished.stderr) == (0, False), finished.stderr
    with answering([Conversation([VECTORS["error"].frame])]) as refusing:
        finished = godot(tmp_path, f"--port={refusing.port}")
    assert finished.returncode == 1
    assert "NO_BOT: no bot 5 on this connection" in finished.stderr
