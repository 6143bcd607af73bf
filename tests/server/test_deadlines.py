"""Deadlines by real doors: answers that leave while the network is still at work, and what follows from them.

Nothing here depends on how fast the machine is: the network waits at a gate, so it always overruns.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from bot_runtime.batch import Batch
from bot_runtime.bots import Bots
from bot_runtime.breaker import Breaker, Probe
from bot_runtime.bundle import Bundle
from bot_runtime.fallback import Reason
from bot_runtime.policy import Policy
from protocol.client import BotClient
from protocol.errors import NonFinite, NotReady, OutOfRange
from tests.protocol.golden import TABLE
from tests.server.serving import Served, costly_numbers, free_numbers, http_request, play, serve

N = 2
SEEDS = [5, 6]
SOON_US = 300_000.0  # long enough for any machine to come as far as the gate
GENEROUS_US = 5e6


class Gate:
    """Holds up the action graph on the worker's thread, when it is shut, until it is opened."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self._open = threading.Event(), threading.Event()
        self._open.set()
        act = Policy.act

        def gated(policy: Policy, batch: Batch) -> None:
            act(policy, batch)
            if not self._open.is_set():
                self.reached.set()
                self._open.wait()

        monkeypatch.setattr(Policy, "act", gated)

    def shut(self) -> None:
        self.reached.clear()
        self._open.clear()

    def open(self) -> None:
        self._open.set()


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gate]:
    gate = Gate(monkeypatch)
    yield gate
    gate.open()


@pytest.fixture
def slow(bundle: Path, tmp_path: Path, gate: Gate) -> Iterator[Served]:
    """A server that answers every turn on the worker's thread."""
    with serve(bundle, tmp_path / "s", inline_us=0.0) as served:
        yield served
        gate.open()


def submission(client: BotClient, bots: np.ndarray, frame: int) -> dict:
    queries = client.query(bots, frame, free_numbers(TABLE, len(bots), frame), np.full(len(bots), 0.25))
    return {"bots": bots, "frame": frame, "acquired": queries.queries, "costly": costly_numbers(TABLE, N, frame)}


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_a_step_that_overruns_is_answered_at_the_deadline_and_everything_after_fits(
    bundle: Path, slow: Served, gate: Gate, door: str
) -> None:
    """The answer leaves while the network is at work; a retry is the same; the next frames know nothing of the step."""
    with BotClient(slow.addresses[door]) as client:
        client.hello()
        bots = client.start(N, seeds=SEEDS)
        last = play(client, TABLE, bots, range(4))[-1]
        said = submission(client, bots, 4)
        gate.shut()
        missed = client.act(**said, deadline_us=SOON_US)
        assert gate.reached.is_set()
        assert missed.reasons.tolist() == [Reason.DEADLINE_LAST_ACTION] * N
        assert np.array_equal(missed.actions, last.actions)
        gate.open()
        retried = client.act(**said, deadline_us=GENEROUS_US)
        assert np.array_equal(retried.actions, missed.actions)
        assert np.array_equal(retried.reasons, missed.reasons)
        after = play(client, TABLE, bots, range(5, 12))
    wanted = Bots(Bundle.load(bundle))
    handles = wanted.start(N, seeds=SEEDS)
    for frame in range(12):
        queries = wanted.request_queries(handles, frame, free_numbers(TABLE, N, frame), np.full(N, 0.25))
        if frame == 4:
            continue  # as if its query had been abandoned
        actions = wanted.submit_features(handles, frame, queries.query_NM, costly_numbers(TABLE, N, frame))
        if frame > 4:
            assert np.array_equal(after[frame - 5].actions, actions.action_NA)


def test_what_waits_behind_a_slow_step_is_refused_at_its_deadline_and_nothing_changed(slow: Served, gate: Gate) -> None:
    with BotClient(slow.addresses["tcp"]) as busy, BotClient(slow.addresses["unix"]) as client:
        busy.hello()
        client.hello()
        theirs, bots = busy.start(N), client.start(N, seeds=SEEDS)
        clean = play(client, TABLE, client.start(N, seeds=SEEDS), range(6))
        first = play(client, TABLE, bots, range(5))
        said = submission(busy, theirs, 0)
        mine = submission(client, bots, 5)
        gate.shut()
        stuck = threading.Thread(target=busy.act, kwargs=said)
        stuck.start()
        gate.reached.wait()
        with pytest.raises(NotReady) as refused:
            client.act(**mine, deadline_us=SOON_US)
        assert refused.value.retry_after_s
        gate.open()
        stuck.join()
        played = [*first, client.act(**mine)]
    assert [got.actions.tobytes() for got in played] == [want.actions.tobytes() for want in clean]


def test_a_shed_query_asks_for_nothing_and_says_so(client: BotClient) -> None:
    bots = client.start(N)
    shed = client.query(bots, 0, free_numbers(TABLE, N, 0), deadline_us=0.0)
    assert shed.reasons.tolist() == [Reason.SHED_QUERY] * N
    assert not shed.queries.any()
    assert not shed.cost_us.any()
    costly = costly_numbers(TABLE, N, 0)
    acted = client.act(bots, 0, shed.queries, costly, deadline_us=GENEROUS_US)
    assert acted.reasons.tolist() == [Reason.SHED_QUERY] * N
    assert not acted.late
    played = client.query(bots, 1, free_numbers(TABLE, N, 1), deadline_us=GENEROUS_US)
    assert played.reasons.tolist() == [0] * N
    held = client.act(bots, 1, played.queries, costly, deadline_us=0.0)
    assert held.reasons.tolist() == [Reason.SHED_LAST_ACTION] * N
    assert np.array_equal(held.actions, acted.actions)


def test_a_reply_after_its_deadline_says_late_and_a_whole_turn_falls_back_too(client: BotClient) -> None:
    bots = client.start(N)
    assert client.query(bots, 0, free_numbers(TABLE, N, 0), deadline_us=0.0).late
    none = np.zeros((N, TABLE.n_queries), dtype=bool)
    taken = client.take(bots, 1, free_numbers(TABLE, N, 1), none, costly_numbers(TABLE, N, 1), deadline_us=0.0)
    assert taken.reasons.tolist() == [Reason.SHED_SAFE_ACTION] * N
    assert taken.late
    assert taken.turns.tolist() == [0] * N


def test_deadlines_that_are_none_are_refused(client: BotClient) -> None:
    bots = client.start(N)
    for bad, refusal in ((-1.0, OutOfRange), (1.1e9, OutOfRange), (np.nan, NonFinite), (np.inf, NonFinite)):
        with pytest.raises(refusal):
            client.query(bots, 0, free_numbers(TABLE, N, 0), deadline_us=bad)
    queries = client.query(bots, 0, free_numbers(TABLE, N, 0)).queries
    with pytest.raises(OutOfRange):
        client.act(bots, 0, queries, costly_numbers(TABLE, N, 0), deadline_us=-1.0)


def test_a_servers_default_counts_where_a_request_says_nothing(bundle: Path, tmp_path: Path) -> None:
    with (
        serve(bundle, tmp_path / "s", default_deadline_us=1.0) as served,
        BotClient(served.addresses["tcp"]) as client,
    ):
        assert client.exchange({"type": "hello"})["deadline_us"] == 1.0
    with serve(bundle, tmp_path / "s", default_deadline_us=1.0) as served, BotClient(served.addresses["tcp"]) as client:
        client.hello()
        bots = client.start(N)
        assert client.query(bots, 0, free_numbers(TABLE, N, 0)).reasons.tolist() == [Reason.SHED_QUERY] * N
        assert not client.query(bots, 1, free_numbers(TABLE, N, 1), deadline_us=GENEROUS_US).reasons.any()


def test_a_large_messages_deadline_is_known_before_it_is_decoded(bundle: Path, tmp_path: Path, gate: Gate) -> None:
    with (
        serve(bundle, tmp_path / "s", max_bots=2048) as served,
        BotClient(served.addresses["tcp"]) as busy,
        BotClient(served.addresses["unix"]) as client,
    ):
        busy.hello()
        client.hello()
        theirs, bots = busy.start(N), client.start(2000)
        said = submission(busy, theirs, 0)
        gate.shut()
        stuck = threading.Thread(target=busy.act, kwargs=said)
        stuck.start()
        gate.reached.wait()
        free = free_numbers(TABLE, 2000, 0)
        assert len(msgpack.packb(free.tobytes())) > 16384
        with pytest.raises(NotReady):
            client.query(bots, 0, free, deadline_us=SOON_US)
        gate.open()
        stuck.join()
        assert not client.query(bots, 0, free).reasons.any()


def test_an_open_breaker_falls_back_at_once_is_not_ready_and_closes_by_a_probe(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    breakers: list[Breaker] = []
    begin = Breaker.__init__

    def noted(breaker: Breaker, clock: Callable[[], int]) -> None:
        begin(breaker, clock)
        breakers.append(breaker)

    monkeypatch.setattr(Breaker, "__init__", noted)
    with serve(bundle, tmp_path / "s") as served, BotClient(served.addresses["tcp"]) as client:
        client.hello()
        bots = client.start(N)
        assert not play(client, TABLE, bots, range(1))[0].reasons.any()
        for _ in range(3):  # what no probe passes
            breakers[0].report("act", Probe(N, -1.0), overran=True)
        assert play(client, TABLE, bots, range(1, 2))[0].reasons.tolist() == [Reason.BREAKER_LAST_ACTION] * N
        ready = http_request(served.addresses["http"], "GET", "/readyz")
        assert ready.status == 503
        assert b"breaker" in ready.body
        breakers[0]._probe = breakers[0]._probe._replace(allowed_us=1e9)  # what any probe passes
        give_up = time.monotonic() + 20.0
        while breakers[0].is_open and time.monotonic() < give_up:
            time.sleep(0.01)
        assert not play(client, TABLE, bots, range(2, 3))[0].reasons.any()
        assert http_request(served.addresses["http"], "GET", "/readyz").status == 200
