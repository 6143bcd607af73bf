"""The C client beside the Python one, at a real server: the same bytes out, the same numbers back.

Skipped where there is no C compiler.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from protocol.client import Actions, BotClient, Queries
from tests.bundles import make_bundle
from tests.clients.engine import ROOT, CClient, Refused, Turn
from tests.protocol.golden import BOTS, TABLE, VECTORS, WELCOME
from tests.protocol.test_client import scripted
from tests.server.serving import Served, costly_numbers, free_numbers, serve

N = 3
TOKEN = "s3cret é"
NONE = np.zeros((N, TABLE.n_queries), dtype=bool)
REFUSAL = VECTORS["error"].frame


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A tiny bundle with the golden vectors' features."""
    bundle = make_bundle(tmp_path_factory.mktemp("b") / "t", features=TABLE, action=WELCOME.action, budget=0.6)
    with serve(bundle, tmp_path_factory.mktemp("socket") / "s", token=TOKEN) as running:
        yield running


@pytest.fixture(params=[("tcp", 0), ("unix", 0), ("tcp", 5000), ("unix", 1)])
def pair(request: pytest.FixtureRequest, served: Served, built: Path) -> Iterator[tuple[CClient, BotClient]]:
    """Both clients, each with a connection of its own, by the same door; ours polls for so many µs before it sleeps."""
    door, spin_us = request.param
    url = served.addresses[door]
    with CClient(built, url, spin_us=spin_us) as ours, BotClient(url) as theirs:
        ours.hello(TOKEN)
        theirs.hello(token=TOKEN)
        yield ours, theirs


@pytest.fixture
def client(served: Served, built: Path) -> Iterator[CClient]:
    with CClient(built, served.addresses["tcp"]) as connected:
        connected.hello(TOKEN)
        yield connected


def are_same(ours: Turn, theirs: Queries | Actions) -> bool:
    rows, numbers = theirs[1], theirs.cost_us if isinstance(theirs, Queries) else theirs.turns
    assert numbers is not None
    there = rows.tobytes(), numbers.tobytes(), theirs.reasons.tobytes(), theirs.late
    return (ours.rows, ours.numbers, ours.reasons, ours.late) == there


@pytest.mark.parametrize("n", [N, 40])
def test_turns_are_those_of_the_python_client_bit_for_bit(pair: tuple[CClient, BotClient], n: int) -> None:
    ours, theirs = pair
    started = {"seeds": [*range(n - 1), 2**63 - 1], "target_returns": np.arange(n) + 0.5, "budgets_us": np.arange(n)}
    bots, their_bots = ours.start(n, **started), theirs.start(n, **started)
    n_asked = 0
    for frame in range(12):
        told = {"free": free_numbers(TABLE, n, frame), "rewards": np.full(n, 0.1 * frame)}
        if frame % 4 == 1:
            told["frame_budget_us"] = 7.25
        if frame % 4 == 2:
            told |= {"budgets_us": np.arange(n)[::-1] + 1.5, "deadline_us": 1e9}
        query, their_query = ours.turn("query", bots, frame, **told), theirs.query(their_bots, frame, **told)
        assert are_same(query, their_query)
        asked, n_asked = their_query.queries, n_asked + int(their_query.queries.sum())
        failed = asked & (np.arange(asked.size).reshape(asked.shape) % 3 == 0) if frame % 3 == 2 else None
        found = {"acquired": asked if failed is None else asked & ~failed, "failed": failed}
        found |= {"costly": costly_numbers(TABLE, n, frame), "acquire_us": 4.0 * frame}
        assert are_same(ours.turn("act", bots, frame, **found), theirs.act(their_bots, frame, **found))
    assert n_asked > 4 * n
    assert ours.stop(bots[1:]) == n - 1
    ours.goodbye()


def test_whole_turns_in_one_message_are_those_of_the_python_client(pair: tuple[CClient, BotClient]) -> None:
    ours, theirs = pair
    bots, their_bots = ours.start(N, seeds=range(N)), theirs.start(N, seeds=range(N))
    for frame in range(6):
        taken = np.zeros_like(NONE)
        taken[:, frame : frame + 2] = True
        turn = {"free": free_numbers(TABLE, N, frame), "acquired": taken, "costly": costly_numbers(TABLE, N, frame)}
        turn |= {"rewards": [0.5] * N, "budgets_us": [18.0] * N, "failed": np.roll(taken, 2, axis=1)}
        assert are_same(ours.turn("take", bots, frame, **turn), theirs.take(their_bots, frame, **turn, hidden=False))


def test_a_retry_gets_the_same_answer_and_changes_nothing(client: CClient) -> None:
    bots = client.start(N, seeds=range(N))
    told = {"free": free_numbers(TABLE, N, 5)}
    queries = client.turn("query", bots, 5, **told)
    assert client.turn("query", bots, 5, **told) == queries  # infer_us too
    acquired = np.frombuffer(queries.rows, np.bool_)
    found = {"acquired": acquired, "costly": costly_numbers(TABLE, N, 5)}
    actions = client.turn("act", bots, 5, **found)
    assert client.turn("act", bots, 5, **found) == actions
    assert np.frombuffer(actions.numbers or b"", np.int64).tolist() == [1] * N


def test_what_the_server_refuses_says_why_and_changes_nothing(client: CClient) -> None:
    bots, free, costly = client.start(N), free_numbers(TABLE, N, 3), np.zeros((N, TABLE.n_costly))
    client.turn("query", bots, 3, free=free)
    for code, name, told in (
        ("NO_BOT", "query", {"bots": [2**62, *bots[1:]], "frame": 4, "free": free}),
        ("STALE_FRAME", "query", {"bots": bots, "frame": 2, "free": free}),
        ("FRAME_REUSED", "query", {"bots": bots, "frame": 3, "free": free, "rewards": [1.0] * N}),
        ("NON_FINITE", "query", {"bots": bots, "frame": 4, "free": np.full_like(free, np.nan)}),
        ("OUT_OF_RANGE", "query", {"bots": bots, "frame": 4, "free": np.full_like(free, 1e6)}),
        ("BAD_SCHEMA", "query", {"bots": bots[:1] * N, "frame": 4, "free": free}),
        ("NO_PENDING_QUERY", "act", {"bots": bots, "frame": 4, "acquired": NONE, "costly": costly}),
        ("UNREQUESTED_FEATURE", "act", {"bots": bots, "frame": 3, "acquired": ~NONE, "costly": costly}),
        ("OVER_BUDGET", "take", {"bots": bots, "frame": 4, "free": free, "acquired": ~NONE, "costly": costly}),
    ):
        with pytest.raises(Refused) as refusal:
            client.turn(name, **told)
        assert (refusal.value.status, refusal.value.code) == (code, code)
        assert refusal.value.detail
    assert client.turn("query", bots, 4, free=free).reasons == bytes(N)
    with pytest.raises(Refused, match="TOO_MANY_BOTS") as refusal:
        client.start(1000)
    assert refusal.value.retry_after_s < 0, "no time will help"
    with pytest.raises(Refused, match="TOO_MANY_BOTS") as refusal:
        client.start(256)
    assert refusal.value.retry_after_s > 0


def test_a_wrong_token_leaves_room_for_the_right_one(served: Served, built: Path) -> None:
    with CClient(built, served.addresses["tcp"]) as client:
        for token in (None, "wrong"):
            with pytest.raises(Refused) as refusal:
                client.hello(token)
            assert refusal.value.code == "UNAUTHORIZED"
        with pytest.raises(Refused, match="NO_CONNECTION"):
            client.start(1)
        client.hello(TOKEN)
        assert len(client.start(1)) == 1
        with pytest.raises(Refused, match="BAD_ARGUMENT: a connection says hello once"):
            client.hello(TOKEN)
        client.goodbye()
        with pytest.raises(Refused, match="NO_CONNECTION"):
            client.start(1)
        client.hello(TOKEN)  # dials again
        assert len(client.start(1)) == 1


def test_once_warm_a_frame_asks_for_no_memory(client: CClient) -> None:
    bots, counts = client.start(N, seeds=range(N)), []
    for frame in range(8):
        queries = client.turn("query", bots, frame, free=free_numbers(TABLE, N, frame), rewards=[0.0] * N)
        acquired = np.frombuffer(queries.rows, np.bool_)
        client.turn("act", bots, frame, acquired=acquired, costly=costly_numbers(TABLE, N, frame))
        counts.append(client.counts().allocations)
    assert len(set(counts[1:])) == 1


GOLDEN_QUERIES = np.array(VECTORS["submit_features"].message["acquired"], dtype=bool)
GOLDEN_FREE = VECTORS["request_queries_all"].message["free"]
GOLDEN_COSTLY = np.zeros((2, TABLE.n_costly))
GOLDEN_COSTLY[0, [0, 1, 9, 10]] = 10.0, 1.0, 8.5, 9.5
GOLDEN_COSTLY[1, 2] = 0.1
SOME_FAILED = VECTORS["submit_features_failed"].message
GOLDEN_CALLS = {
    "start_bots": ("start", {"count": 2}),
    "start_bots_all": ("start", {k: v for k, v in VECTORS["start_bots_all"].message.items() if k != "type"}),
    "request_queries": ("query", {"bots": BOTS[:1], "frame": 0, "free": GOLDEN_FREE[:1]}),
    "request_queries_all": ("query", {k: v for k, v in VECTORS["request_queries_all"].message.items() if k != "type"}),
    "submit_features": ("act", {}),
    "submit_features_failed": ("act", {name: SOME_FAILED[name] for name in ("acquired", "failed")}),
    "submit_features_measured": ("act", {"acquire_us": 40.5}),
    "submit_features_deadline": ("act", {"deadline_us": 8000.0}),
    "take_turn": ("take", {"free": GOLDEN_FREE}),
    "stop_bots": ("stop", {"bots": BOTS}),
}


def test_requests_are_the_golden_bytes(built: Path) -> None:
    replies = [VECTORS["welcome"].frame, *[REFUSAL] * (len(GOLDEN_CALLS) + 1)]
    with scripted(replies) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        client.hello()
        calls = {"start": client.start, "stop": client.stop, "query": partial(client.turn, "query")}
        calls |= {
            name: partial(client.turn, name, BOTS, 7, acquired=GOLDEN_QUERIES, costly=GOLDEN_COSTLY)
            for name in ("act", "take")
        }
        for name, told in GOLDEN_CALLS.values():
            with pytest.raises(Refused, match="no bot 5"):
                calls[name](**told)
        with pytest.raises(Refused, match="no bot 5"):
            client.goodbye()
    names = ["hello", *GOLDEN_CALLS, "goodbye"]
    assert dict(zip(names, heard, strict=True)) == {name: VECTORS[name].frame for name in names}


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("hello_bundle", {"bundle": "golden@3"}),
        (
            "hello_cost_model_token",
            {"token": TOKEN, "call_us": 16.0, "feature_us": WELCOME.cost_model.feature_us},
        ),
    ],
)
def test_hellos_are_the_golden_bytes(name: str, told: dict, built: Path) -> None:
    with scripted([VECTORS["welcome"].frame]) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        client.hello(**told)
    assert heard == [VECTORS[name].frame]


def test_golden_replies_are_read_as_what_they_say(built: Path) -> None:
    replies = ["welcome", "bots_started", "queries", "queries_shed", "actions", "actions_late", "actions_hidden"]
    frames = [VECTORS[name].frame for name in (*replies, "bots_stopped", "farewell")]
    with scripted(frames) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        said = " ".join(client.hello())
        assert client.start(2) == BOTS
        turns = [client.turn("query", BOTS, 7, free=GOLDEN_FREE) for _ in range(2)]
        found = {"acquired": GOLDEN_QUERIES, "costly": GOLDEN_COSTLY}
        turns += [client.turn("act", BOTS, 7, **found) for _ in range(3)]
        assert client.stop(BOTS) == 2
        client.goodbye()
        assert client.counts().late == 2
    assert said.startswith("00112233445566778899aabbccddeeff golden 3 10 11 2 16 9 20 256 65536 nan 0.998")
    assert f"nan 100 58 3 {'0123456789abcdef' * 4}." in said
    assert "ray_00:2:4.5:0:50 " in said
    assert "jump:0:1:0 " in said
    for name, turn in zip(replies[2:], turns, strict=True):
        message = VECTORS[name].message
        rows = message.get("queries") or np.array(message.get("actions"), np.float32)
        numbers = message.get("cost_us") or np.array(message.get("turns"), np.int64)
        reasons, late = message["reasons"] or [0, 0], message["late"]
        whole = np.array(rows).astype(np.bool_ if "queries" in message else np.float32).tobytes()
        assert turn == Turn(whole, np.array(numbers).tobytes(), bytes(reasons), message["infer_us"], late)


def test_the_example_plays(served: Served, built: Path, tmp_path: Path) -> None:
    with serve(make_bundle(tmp_path / "b"), tmp_path / "s") as open_to_all:
        played = subprocess.run(
            [built / "example", open_to_all.addresses["unix"], "2", "3"], capture_output=True, text=True, check=True
        )
    assert [line.split(":")[0] for line in played.stdout.splitlines()] == [
        f"frame {frame} bot {bot}" for frame in range(3) for bot in range(2)
    ]
    refused = subprocess.run([built / "example", served.addresses["tcp"]], capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stderr.split()[1]) == (1, "UNAUTHORIZED")


@pytest.mark.parametrize("compiler", [("cc", "-xc", "-std=c99"), ("c++", "-xc++", "-std=c++11")], ids=["c", "c++"])
def test_the_frame_of_the_readme_compiles(compiler: tuple[str, ...], built: Path, tmp_path: Path) -> None:
    if shutil.which(compiler[0]) is None:
        pytest.skip(f"no {compiler[0]} here")
    folder = ROOT / "clients" / "c"
    (code,) = re.findall(r"```c\n(.*?)```", (folder / "README.md").read_text("utf-8"), re.S)
    (tmp_path / "frame.c").write_text(code, "utf-8")
    checks = "-Wall", "-Wextra", "-Werror", "-pedantic", "-fsyntax-only"
    subprocess.run([*compiler, *checks, f"-I{folder}", str(tmp_path / "frame.c")], check=True)
