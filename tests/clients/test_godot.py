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
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from protocol.client import BotClient
from tests.clients.fake_server import Conversation, answering, framed
from tests.protocol.golden import BOTS, REFUSED, REPLIES, REQUESTS, VECTORS
from tests.server.serving import costly_numbers, free_numbers, serve

ROOT = Path(__file__).resolve().parents[2]
GODOT = shutil.which("godot3-server") or shutil.which("godot3")
pytestmark = pytest.mark.skipif(GODOT is None, reason="needs Godot 3 without a display: apt-get install godot3-server")

SEEDS = [3, 2**63 - 1, 5, 7, 11]
BUDGETS_US = [98.4, 98.4, 40.0, 5.0, 0.0]
FRAMES, ERRORS_AT, FAILS_AT = range(2, 26, 2), 8, {12, 14}
SAID = ["hello", "hello_cost_model_token", "hello_bundle", "start_bots", "start_bots_all"]
SAID += ["request_queries", "request_queries_all", "submit_features", "submit_features_failed"]
SAID += ["submit_features_measured", "submit_features_deadline", "stop_bots", "goodbye"]


def godot(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """One run of the engine, whose own files go to `folder`."""
    home = {"HOME": str(folder), "XDG_DATA_HOME": str(folder), "LC_ALL": "C.UTF-8", "PATH": os.environ["PATH"]}
    command = [str(GODOT), "--path", str(ROOT / "clients" / "godot"), *arguments]
    return subprocess.run(command, env=home, capture_output=True, text=True, timeout=30, check=False)


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def mutated(body: bytes, seed: int) -> bytes:
    """The body with one to three bytes changed, or cut, or both."""
    random = np.random.default_rng(seed)
    changed = bytearray(body)
    for at in random.integers(0, len(body), int(random.integers(1, 4))):
        changed[at] = int(random.integers(0, 256))
    return bytes(changed if random.random() < 0.8 else changed[: int(random.integers(0, len(body)))])


# --- msgpack ---------------------------------------------------------------------------------------------------------


def codec_cases() -> list[bytes]:
    golden = [vector.body for vector in VECTORS.values()]
    cut = [VECTORS[name].body[:end] for name in ("queries", "error_retry") for end in range(len(VECTORS[name].body))]
    wild = [mutated(VECTORS[name].body, seed) for seed in range(100) for name in ("welcome", "start_bots_all")]
    numbers = [msgpack.packb([sign * 2**bits + off for sign in (1, -1) for off in (-1, 0, 1)]) for bits in range(63)]
    sizes = [msgpack.packb([b"x" * size, "y" * size]) for size in (0, 15, 16, 31, 32, 255, 256, 65535, 65536)]
    sizes += [msgpack.packb({"x": [None] * size, **dict.fromkeys("abcdefghijklmnopqrst"[:size])}) for size in range(20)]
    narrow = [msgpack.packb(-0.1, use_single_float=True), msgpack.packb({"é": [float("inf"), -0.0]})]
    odd = [
        msgpack.packb(2**63),
        msgpack.packb("a\0b"),
        msgpack.packb({1: 2}),
        b"\x91" * 16 + b"\xc0",
        b"\x91" * 17 + b"\xc0",
    ]
    return golden + cut + wild + numbers + sizes + narrow + odd


def readable(body: bytes) -> tuple[bool, Any]:
    """Whether this client's subset of msgpack holds these bytes, and what they say."""
    try:
        value = msgpack.unpackb(body, strict_map_key=False)
    except (ValueError, TypeError):  # the package raises the latter for the key of a map that is a map
        return False, None
    return within(value, 0), value


def within(value: Any, depth: int) -> bool:
    if isinstance(value, dict):
        return depth < 16 and all(
            isinstance(k, str) and within(k, 0) and within(v, depth + 1) for k, v in value.items()
        )
    if isinstance(value, list):
        return depth < 16 and all(within(each, depth + 1) for each in value)
    if isinstance(value, str):
        return "\0" not in value
    if isinstance(value, int):
        return value < 2**63
    return value is None or isinstance(value, float | bytes)


def shown(value: Any) -> Any:
    """As the runner shows it."""
    match value:
        case bool() | None:
            return value
        case int():
            return f"i{value}"
        case float():
            return "f" + struct.pack(">d", value).hex()
        case str():
            return "s" + value.encode().hex()
        case bytes():
            return "b" + value.hex()
        case list():
            return [shown(each) for each in value]
    return {key.encode().hex(): shown(each) for key, each in value.items()}


# --- a server that is no good ----------------------------------------------------------------------------------------

WELCOME_FRAME, QUERIES_FRAME = VECTORS["welcome"].frame, VECTORS["queries"].frame
HOSTILE: dict[str, tuple[Conversation, tuple[Any, ...]]] = {  # what is said, and code, retry_after_s, is_open
    "refused": (Conversation([VECTORS["error"].frame]), ("NO_BOT", None, True)),
    "refused for now": (Conversation([VECTORS["error_retry"].frame]), ("TOO_MANY_BOTS", 1.0, True)),
    "a code from the future": (
        Conversation([framed(msgpack.packb({"type": "error", "code": "NEW", "detail": "?"}))]),
        ("INTERNAL", None, True),
    ),
    "drop by drop": (Conversation([WELCOME_FRAME[:40], b""], drops=1), ("TIMED_OUT", None, False)),
    "whole, in drops": (Conversation([WELCOME_FRAME, QUERIES_FRAME], drops=100), (None, None, True)),
    "too long": (Conversation([b"\xff\xff\xff\xff"]), ("BAD_REPLY", None, False)),
    "a little too long": (Conversation([struct.pack(">I", 2**20 + 1)]), ("BAD_REPLY", None, False)),
    "too long for two bots": (Conversation([WELCOME_FRAME, struct.pack(">I", 70000)]), ("BAD_REPLY", None, False)),
    "cut": (Conversation([WELCOME_FRAME[:100]], closes=True), ("CONNECTION_LOST", None, False)),
    "cut in the length": (Conversation([WELCOME_FRAME[:3]], closes=True), ("CONNECTION_LOST", None, False)),
    "closed at once": (Conversation([], closes=True), ("CONNECTION_LOST", None, False)),
    "silent": (Conversation([b""]), ("TIMED_OUT", None, False)),
    "empty": (Conversation([framed(b"")]), ("BAD_REPLY", None, False)),
    "garbage": (Conversation([framed(b"\xc1" * 50)]), ("BAD_REPLY", None, False)),
    "a bomb": (Conversation([framed(b"\xdd\xff\xff\xff\xff")]), ("BAD_REPLY", None, False)),
    "another reply": (Conversation([VECTORS["bots_started"].frame]), ("BAD_REPLY", None, False)),
    "two replies": (Conversation([WELCOME_FRAME + b"\0" * 9]), ("BAD_REPLY", None, False)),
    "cut later": (Conversation([WELCOME_FRAME, QUERIES_FRAME[:9]], closes=True), ("CONNECTION_LOST", None, False)),
    "another frame": (
        Conversation([WELCOME_FRAME, framed(msgpack.packb({**VECTORS["queries"].message, "frame": 8}))]),
        ("BAD_REPLY", None, False),
    ),
    "late": (Conversation([WELCOME_FRAME, QUERIES_FRAME]), (None, None, True)),
}


def packed(name: str, **changed: Any) -> bytes:
    return bytes(msgpack.packb({**msgpack.unpackb(VECTORS[name].body), **changed}))


def wrong_replies() -> list[tuple[str, bytes]]:
    """Replies that are msgpack and wrong all the same, by what they answer."""
    inf = struct.pack("<4f", 0.0, float("inf"), 0.0, 0.0)
    features = VECTORS["welcome"].message["features"]["features"]
    tables = [[], features[:1] * 2, [{**features[0], "size": 0}], [{**features[0], "low": float("nan")}], [7], None]
    return [
        *(("hello", packed("welcome", features={"features": table})) for table in tables),
        *(("hello", packed("welcome", **{name: 7})) for name in ("features", "action", "cost_model")),
        ("hello", packed("welcome", action={"components": []})),
        ("hello", packed("welcome", cost_model={"call_us": 1.0, "feature_us": [1.0]})),
        ("hello", packed("welcome", deadline_us="soon")),
        ("hello", packed("welcome", max_body_bytes=None)),
        *(("start_bots", packed("bots_started", bots=bots)) for bots in (None, [1], [1, 1], [1, -1], [1.0, 2.0])),
        *(("request_queries", packed("queries", queries=bits)) for bits in (b"", b"\0\0\0", b"\0\x04\0\0", "\0\0\0\0")),
        *(("request_queries", packed("queries", reasons=reasons)) for reasons in ([0], [0, 256], [0, None], 7)),
        *(("request_queries", packed("queries", cost_us=costs)) for costs in (None, [1.0], [1.0, "1"])),
        ("request_queries", packed("queries", infer_us=None)),
        ("request_queries", packed("queries", frame=7.0)),
        *(("submit_features", packed("actions", actions=blob)) for blob in (None, b"", b"\0" * 15, inf)),
        *(("submit_features", packed("actions", reasons=reasons)) for reasons in (None, [0])),
        *(("submit_features", packed("actions", turns=turns)) for turns in ([1], [1, "2"])),
        ("stop_bots", packed("bots_stopped", count="2")),
        ("stop_bots", msgpack.packb([1, 2])),
        ("stop_bots", msgpack.packb({"count": 2})),
    ]


MESSAGES = {
    "hello": {"type": "hello"},
    "start_bots": {"type": "start_bots", "count": 2},
    "request_queries": {"type": "request_queries", "frame": 7, "bots": BOTS},
    "submit_features": {"type": "submit_features", "frame": 7, "bots": BOTS},
    "stop_bots": {"type": "stop_bots", "bots": BOTS},
}
ANSWERS = {
    "hello": "welcome",
    "start_bots": "bots_started",
    "request_queries": "queries",
    "submit_features": "actions",
    "stop_bots": "bots_stopped",
}
GOOD = [*ANSWERS.items(), ("request_queries", "queries_shed"), ("submit_features", "actions_late")]
GOOD += [("submit_features", "actions_hidden"), ("hello", "welcome_no_context_target_cost")]


def read_cases() -> list[dict[str, Any]]:
    good = [(asked, VECTORS[answer].body) for asked, answer in GOOD]
    wild = [(asked, mutated(VECTORS[answer].body, seed)) for asked, answer in ANSWERS.items() for seed in range(60)]
    return [{"message": MESSAGES[asked], "body": b64(body)} for asked, body in good + wrong_replies() + wild]


# --- what the client says --------------------------------------------------------------------------------------------


def answer_to(name: str) -> bytes:
    """A golden reply that fits the golden request."""
    message = VECTORS[name].message
    if message["type"] == "request_queries":
        n = len(message["bots"])
        return framed(packed("queries", frame=message["frame"], queries=b"\0" * 2 * n, cost_us=[0.0] * n))
    return VECTORS[{**ANSWERS, "goodbye": "farewell"}[message["type"]]].frame


def sayable(name: str) -> dict[str, Any]:
    message = dict(VECTORS[name].message)
    return {**message, "seeds": [str(seed) for seed in message["seeds"]]} if "seeds" in message else message


# --- rays ------------------------------------------------------------------------------------------------------------

CLASSES = ["nothing", "ground", "wall", "lava"]
ROOM = [
    {"group": "own", "middle": [0, 0.7, 0], "half": [0.3, 0.7, 0.3]},
    {"group": "ground", "middle": [0, -0.5, 0], "half": [30, 0.5, 30]},
    {"group": "wall", "middle": [0, 1, -5], "half": [3, 1, 0.5]},
    {"group": "lava", "middle": [-6, 1, 0], "half": [1, 1, 1]},
    {"group": "unnamed", "middle": [3, 1, 3], "half": [0.5, 1, 0.5]},
]
FREE = {"name": "position", "size": 3, "cost_us": 0.0, "low": -1.0, "high": 1.0}
RAYS = {  # with a heading of 90 degrees to the left of -z, so ahead is -x: distance and class
    "ray_l000_d00_r010": (5.0, "lava"),
    "ray_r090_d00_r010": (4.5, "wall"),
    "ray_r180_d00_r010": (10.0, "nothing"),
    "ray_l180_d45_r005": (1.2 * 2**0.5, "ground"),
    "ray_r090_u45_r005": (5.0, "nothing"),
    "ray_r090_d00_r003": (3.0, "nothing"),
    "ray_l135_d00_r010": (2.5 * 2**0.5, "ground"),  # in no group that names a class
}


def rays_scenario() -> dict[str, Any]:
    features = [
        {"name": name, "size": 1 + len(CLASSES), "cost_us": 2.0, "low": 0.0, "high": float(name[-3:])} for name in RAYS
    ]
    return {"classes": CLASSES, "heading_deg": 90, "boxes": ROOM, "features": [FREE, *features]}


# --- the run ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The TCP address of a real server."""
    with serve(ROOT / "bundles" / "hard", tmp_path_factory.mktemp("served") / "s") as served:
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
    with socket.create_server(("127.0.0.1", 0)) as unused:
        closed_port = unused.getsockname()[1]
    hostile = [{"query": len(said.answers) > 1, "timeout_s": 5 if code != "TIMED_OUT" else 0.2}
               for said, (code, *_) in HOSTILE.values()]  # fmt: skip
    with (
        answering([conversation for conversation, _ in HOSTILE.values()]) as bad,
        answering([Conversation([answer_to(name) for name in SAID])]) as golden,
    ):
        scenario = {
            "codec": [b64(body) for body in codec_cases()],
            "read": read_cases(),
            "closed_port": closed_port,
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
    codes = [(result["code"], result["detail"]) for result in run["read"][good : good + wrong]]
    assert [code for code, _ in codes] == ["BAD_REPLY"] * wrong, codes
    assert {result["ok"] for result in run["read"][good + wrong :]} == {True, False}  # changed at random: no crash


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
    with answering([Conversation([VECTORS["error"].frame])]) as refusing:
        finished = godot(tmp_path, f"--port={refusing.port}")
    assert finished.returncode == 1
    assert "NO_BOT: no bot 5 on this connection" in finished.stderr
