"""The C client before servers that misbehave, and callers that do: an error each time, under silent sanitizers."""

from __future__ import annotations

import random
import socket
import struct
import subprocess
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from protocol.replies import read_actions, read_bots_started, read_queries, read_reply, read_welcome
from tests.clients.engine import CClient, Refused, Turn
from tests.protocol.golden import BOTS, TABLE, VECTORS
from tests.protocol.test_client import scripted

FREE = np.zeros((2, TABLE.n_free))
NONE = np.zeros((2, TABLE.n_queries), dtype=bool)
COSTLY = np.zeros((2, TABLE.n_costly))
WELCOME, QUERIES, ACTIONS = (VECTORS[name].frame for name in ("welcome", "queries", "actions"))
ASKED = {"welcome": "h", "bots_started": "s", "queries": "q", "actions": "a", "bots_stopped": "t", "farewell": "g"}
N_MUTANTS = 20_000


def frame_of(message: Any) -> bytes:
    body = msgpack.packb(message)
    return struct.pack(">I", len(body)) + body


def plain(name: str, **changed: Any) -> dict[str, Any]:
    """A golden reply as msgpack has it, with other values in some fields."""
    return {**msgpack.unpackb(VECTORS[name].body), **changed}


def without(name: str, *fields: str) -> dict[str, Any]:
    return {field: value for field, value in plain(name).items() if field not in fields}


def answered(built: Path, *replies: bytes, call: str = "query", frame: int = 7, **how: Any) -> Turn | list[str]:
    """What a turn of the golden bots returns where the server answers hello and it with these bytes, then hangs up."""
    with scripted([*replies]) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}", **how) as client:
        said = client.hello()
        if len(replies) == 1:
            return said
        try:
            if call == "start":
                client.start(2)
            return client.turn(call, BOTS, frame, free=FREE, acquired=NONE, costly=COSTLY)
        except Refused as refusal:
            if refusal.status in ("BAD_REPLY", "CLOSED"):
                with pytest.raises(Refused, match="NO_CONNECTION"):  # the socket is closed, for a late reply may come
                    client.stop(BOTS)
            raise


@pytest.mark.parametrize(
    ("reply", "status"),
    [
        (b"", "CLOSED"),
        (b"\0\0", "CLOSED"),
        (QUERIES[:-1], "CLOSED"),
        (struct.pack(">I", 2**20) + b"\x80", "CLOSED"),
        (struct.pack(">I", 0), "BAD_REPLY"),
        (struct.pack(">I", 64 * 2**20 + 1), "BAD_REPLY"),
        (struct.pack(">I", 2**32 - 1), "BAD_REPLY"),
        (struct.pack(">I", 1) + b"\xc1", "BAD_REPLY"),
        (struct.pack(">I", 5) + b"\xdf\xff\xff\xff\xff", "BAD_REPLY"),
        (struct.pack(">I", 2**17) + b"\x91" * 2**17, "BAD_REPLY"),
        (QUERIES + b"\0", "BAD_REPLY"),
        (frame_of([]), "BAD_REPLY"),
        (frame_of({}), "BAD_REPLY"),
        (frame_of({"type": 7}), "BAD_REPLY"),
        (frame_of({1: 2, **plain("queries")}), "BAD_REPLY"),
        (ACTIONS, "BAD_REPLY"),
        (frame_of(plain("queries", frame=8)), "BAD_REPLY"),
        (frame_of({"type": "error", "code": "NO_BOT"}), "BAD_REPLY"),
        (frame_of({"type": "error", "code": "NO_BOT", "detail": "", "retry_after_s": float("nan")}), "BAD_REPLY"),
    ],
)
def test_what_is_no_reply_is_an_error_and_ends_the_connection(reply: bytes, status: str, built: Path) -> None:
    with pytest.raises(Refused) as refusal:
        answered(built, WELCOME, reply)
    assert refusal.value.status == status
    assert refusal.value.code == ""


BAD_FIELDS = {
    "queries": {
        "frame": [7.5, "7", None, -7, 2**64 - 1],
        "queries": [b"", b"\1\2\3", b"\1\2\3\0\0", b"\0\4\0\0", "1230", None],
        "cost_us": [[1.0], [1.0, 2.0, 3.0], [1.0, "2"], [float("inf"), 0.0], [-1.0, 0.0], b"ab", None],
        "infer_us": [None, "1", float("nan"), -1.0],
        "reasons": [[0], [0, 256], [0, -1], [0, 0.5], b"\0\0", []],
        "late": [1, "yes"],
    },
    "actions": {
        "frame": [None, 6],
        "actions": [b"", b"\0" * 15, b"\0" * 17, struct.pack("<4f", 0, 0, 0, float("nan")), None, [[0.0, 0.0]] * 2],
        "reasons": [None, [0], [0, 0, 0], [0, 999]],
        "infer_us": [None, float("inf")],
        "turns": [[1], [1, -1], [1, 2**63], "12"],
        "late": ["no"],
    },
}
BAD_ACTIONS = [struct.pack("<4f", *row) for row in ([1.5, 0, 0, 0], [0, 0, 0, -0.5], [float("inf"), 0, 0, 0])]


@pytest.mark.parametrize("name", BAD_FIELDS)
def test_a_field_of_another_type_length_or_range_is_an_error(name: str, built: Path) -> None:
    wrong = [plain(name, **{field: value}) for field, values in BAD_FIELDS[name].items() for value in values]
    wrong += [without(name, field) for field in ("frame", "infer_us", name)]
    wrong += [plain("actions", actions=blob) for blob in BAD_ACTIONS] if name == "actions" else []
    assert set(letters(built, [(ASKED[name], msgpack.packb(message)) for message in wrong])) == {"x"}
    with pytest.raises(Refused, match="BAD_REPLY"):
        answered(built, WELCOME, frame_of(wrong[0]), call={"queries": "query", "actions": "act"}[name])


def test_a_welcome_is_held_to_what_the_protocol_allows(built: Path) -> None:
    feature, component = plain("welcome")["features"]["features"][1], plain("welcome")["action"]["components"][0]
    many = [{**feature, "name": f"ray_{i}"} for i in range(1025)]
    tables = [
        [],
        many,
        [feature, feature],
        [{**feature, "size": 0}],
        [{**feature, "size": 4097}],
        [{**feature, "size": 1.0}],
    ]
    tables += [[{**feature, field: value}] for field in ("low", "high") for value in (1e39, float("nan"), None)]
    tables += [[{**feature, "cost_us": value}] for value in (-1.0, float("nan"), 1e7)]
    tables += [[{**feature, "name": value}] for value in ("", "x" * 65, "a b", "a-b", "1a", "é", 1)]
    actions = [[], [component] * 1025, [{**component, "safe": 2.0}], [{**component, "low": 1.0}]]
    costs = [{"call_us": 1.0}, {"call_us": -1.0, "feature_us": [1.0] * 10}, {"call_us": 0.0, "feature_us": [1.0] * 9}]
    wrong = [plain("welcome", features={"features": table}) for table in tables]
    wrong += [plain("welcome", action={"components": each}) for each in actions]
    wrong += [plain("welcome", cost_model=each) for each in (*costs, {}, None, [])]
    wrong += [plain("welcome", **{field: None}) for field in ("connection", "bundle", "max_bots", "budget_us")]
    wrong += [plain("welcome", **{field: "1"}) for field in ("target_cost_us", "deadline_us", "replay_frames")]
    wrong += [plain("welcome", connection="x" * 65), plain("welcome", bundle_sha256="x" * 65)]
    bodies = [msgpack.packb(message) for message in wrong]
    assert letters(built, [("h", VECTORS["welcome"].body), *(("h", body) for body in bodies)], is_served=True) == (
        "." + "x" * len(bodies)
    )
    with pytest.raises(Refused, match="BAD_REPLY"):
        answered(built, frame_of(wrong[0]))


def test_fields_and_codes_of_a_newer_server_and_of_an_older_one(built: Path) -> None:
    newer = frame_of({"colour": [{"a": {"b": [1, None]}}], **plain("queries"), "shade": msgpack.ExtType(5, b"x")})
    assert isinstance(answered(built, WELCOME, newer), Turn)
    for name, reply in (("query", without("queries", "reasons", "late")), ("act", without("actions", "turns", "late"))):
        turn = answered(built, WELCOME, frame_of(reply), call=name)
        assert isinstance(turn, Turn)
        assert (turn.numbers is None, turn.late) == (name == "act", False)
    text = "why \x1b[2J\0é"
    with pytest.raises(Refused) as refusal:
        answered(built, WELCOME, frame_of({"type": "error", "code": "BRAND_NEW", "detail": text + "." * 999}))
    assert (refusal.value.status, refusal.value.code) == ("INTERNAL", "BRAND_NEW")
    assert refusal.value.detail.startswith("why ?[2J???..")
    assert len(refusal.value.detail) == 300
    newest = ("target_cost_us", "cost_quantile", "bundle_version", "bundle_sha256", "replay_frames", "target_return")
    older = frame_of(without("welcome", *newest, "deadline_us"))
    with scripted([older]) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        client.hello()
        for name, told in (
            ("query", {"deadline_us": 1.0}),
            ("query", {"budgets_us": [1.0, 1.0]}),
            ("act", {"acquire_us": 1.0}),
            ("take", {}),
        ):
            with pytest.raises(Refused, match="UNSUPPORTED"):
                client.turn(name, BOTS, 7, free=FREE, acquired=NONE, costly=COSTLY, **told)
    assert len(heard) == 1


def test_arguments_that_cannot_be_sent_are_not(built: Path) -> None:
    for url in ("", "http://127.0.0.1:1", "tcp://host", "tcp://:1", "tcp://h:0", "tcp://h:65536", "tcp://h:1/x",
                "tcp://[::1", "unix://s", "unix:///" + "x" * 200):  # fmt: skip
        with pytest.raises(Refused, match="BAD_ARGUMENT"), CClient(built, url):
            pass
    small = frame_of(plain("welcome", max_body_bytes=60))
    with scripted([small]) as (port, heard), CClient(built, f"tcp://127.0.0.1:{port}") as client:
        with pytest.raises(Refused, match="NO_CONNECTION"):
            client.start(1)
        client.hello()
        for call in (
            lambda: client.start(0),
            lambda: client.start(65537),
            lambda: client.start(1, seeds=[-1]),
            lambda: client.stop([]),
            lambda: client.turn("query", [], 7, free=FREE),
            lambda: client.turn("query", BOTS, -1, free=FREE),
            lambda: client.turn("query", BOTS, 2**53 + 1, free=FREE),
            lambda: client.turn("query", BOTS, 7),
            lambda: client.turn("act", BOTS, 7, acquired=NONE),
            lambda: client.turn("query", BOTS, 7, free=FREE),  # longer than max_body_bytes
        ):
            with pytest.raises(Refused, match="BAD_ARGUMENT"):
                call()
    assert len(heard) == 1


def test_nobody_there_and_nobody_answering(built: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        with CClient(built, url, timeout_ms=50) as client, pytest.raises(Refused, match="TIMEOUT"):
            client.hello()
    for nobody in (url, f"unix://{tmp_path}/none"):
        with pytest.raises(Refused, match="SYSTEM"), CClient(built, nobody):
            pass


def test_an_answer_is_late_by_the_engines_clock_whatever_it_says(built: Path) -> None:
    """A clock that is looked at before a request and after its answer, and goes 1 ms each time."""
    replies = [WELCOME, QUERIES, QUERIES, QUERIES, ACTIONS]
    with scripted(replies) as (port, _), CClient(built, f"tcp://127.0.0.1:{port}", clock_step_ns=10**6) as client:
        client.hello()
        late = [client.turn("query", BOTS, 7, free=FREE, deadline_us=us).late for us in (1000.0, 999.0, None)]
        late.append(client.turn("act", BOTS, 7, acquired=NONE, costly=COSTLY, deadline_us=0.0).late)
        assert late == [False, True, False, True]
        assert client.counts()[0] == 2
    default = frame_of(plain("welcome", deadline_us=999.0))
    turn = answered(built, default, QUERIES, clock_step_ns=10**6)
    assert isinstance(turn, Turn)
    assert turn.late


def test_a_reply_may_come_byte_by_byte(built: Path) -> None:
    def dribble(listening: socket.socket) -> None:
        accepted, _ = listening.accept()
        with accepted:
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for reply in (WELCOME, QUERIES):
                accepted.recv(65536)
                for byte in reply:
                    accepted.sendall(bytes([byte]))

    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=dribble, args=[listening])
        thread.start()
        with CClient(built, f"tcp://127.0.0.1:{listening.getsockname()[1]}") as client:
            client.hello()
            assert client.turn("query", BOTS, 7, free=FREE).infer_us == 80.25
        thread.join()


def test_where_memory_ends_nothing_else_does(built: Path) -> None:
    """The engine's allocator refuses from its first call on, from its second, and so on until nothing is refused."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        url = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        thread = threading.Thread(target=answer_forever, args=[listening])
        thread.start()
        refusals = [refusal_of_a_turn(built, url, n_allowed) for n_allowed in range(20)]
        with socket.create_connection(listening.getsockname()) as last:
            last.sendall(b"goodbye")
        thread.join()
    n = refusals.index("")
    assert n > 8
    assert refusals == ["NO_MEMORY"] * n + [""] * (20 - n)


def refusal_of_a_turn(built: Path, url: str, n_allowed: int) -> str:
    try:
        with CClient(built, url, n_allowed=n_allowed) as client:
            client.hello()
            client.start(2)
            client.turn("query", BOTS, 7, free=FREE)
    except Refused as refusal:
        return refusal.status
    return ""


def answer_forever(listening: socket.socket) -> None:
    """Golden replies to each socket in turn, until one says goodbye."""
    replies = {b"hello": WELCOME, b"start_bots": VECTORS["bots_started"].frame, b"request_queries": QUERIES}
    while True:
        accepted, _ = listening.accept()
        with accepted, suppress(ConnectionError):
            while heard := accepted.recv(65536):
                if heard == b"goodbye":
                    return
                accepted.sendall(next(reply for kind, reply in replies.items() if kind in heard))


def letters(built: Path, cases: list[tuple[str, bytes]], *, is_served: bool = False) -> str:
    """What `mutants` says of each body: `.` read, `r` refused by the server, `x` no reply. None of them ends it."""
    first = [] if is_served else [("h", VECTORS["welcome"].body)]
    stream = b"".join(kind.encode() + struct.pack("<I", len(body)) + body for kind, body in (*first, *cases))
    done = subprocess.run([built / "mutants"], input=stream, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode()[len(first) :]


HEADS = bytes([0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, *range(0xC0, 0xE0), 0xFF, 0, 0x7F])


def mutated(body: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """The same with one to three faults: bytes changed, cut out, put in, or taken from another reply."""
    mutant = bytearray(body)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(mutant) + 1)
        match rng.randrange(6):
            case 0 if at < len(mutant):
                mutant[at] ^= 1 << rng.randrange(8)
            case 1 if at < len(mutant):
                mutant[at] = rng.choice(HEADS)
            case 2:
                del mutant[at:]
            case 3:
                del mutant[at : at + rng.randint(1, 8)]
            case 4:
                mutant[at:at] = bytes([rng.choice(HEADS)]) + rng.randbytes(rng.randrange(9))
            case 5:
                other = rng.choice(others)
                start = rng.randrange(len(other))
                mutant[at:at] = other[start : start + rng.randint(1, 40)]
    return bytes(mutant)


def is_well_formed(body: bytes) -> bool:
    """Whether the `msgpack` package finds one value here; it looks into texts and ext types too, which we skip."""
    try:
        msgpack.unpackb(body, raw=True, strict_map_key=False, ext_hook=lambda *_: None)
    except (ValueError, TypeError):
        return False
    return True


def test_thousands_of_mutated_replies_are_read_or_refused_within_their_bytes(built: Path) -> None:
    rng = random.Random(16)
    golden = [(ASKED.get(vector.message["type"], "q"), vector.body) for vector in VECTORS.values() if is_reply(vector)]
    bodies = [body for _, body in golden]
    assert letters(built, golden) == "".join("r" if b"error" in body else "." for body in bodies)
    cases = [(kind, mutated(body, bodies, rng)) for kind, body in (rng.choice(golden) for _ in range(N_MUTANTS))]
    verdicts = letters(built, cases)
    assert min(verdicts.count(letter) for letter in ".rx") > N_MUTANTS / 200
    for (kind, body), verdict in zip(cases, verdicts, strict=True):
        assert verdict == "x" or is_well_formed(body)
        assert verdict != "." or is_read_by_the_python_client(kind, body)


def is_read_by_the_python_client(kind: str, body: bytes) -> bool:
    request = {"h": "hello", "s": "start_bots", "q": "request_queries", "a": "submit_features", "t": "stop_bots"}
    try:
        msgpack.unpackb(body)
    except ValueError:
        return True  # texts that are not UTF-8, or odd keys, in what the C client does not look into
    golden, reply = read_welcome(plain("welcome")), read_reply(body, request.get(kind, "goodbye"))
    reply.pop("hidden", None)  # which the C client does not ask for
    match kind:
        case "h":
            read_welcome(reply)
        case "s":
            read_bots_started(reply, golden)
        case "q":
            read_queries(reply, 2, TABLE)
        case "a":
            read_actions(reply, 2, golden.action)
    return True


def is_reply(vector: Any) -> bool:
    return vector.description["direction"] == "reply"
