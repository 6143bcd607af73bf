"""THREATS 20: the server dies at any request, and what the engine sees is the run without interruption, to the bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from protocol.errors import NoBot, NoConnection, NoPendingQuery, OutOfRange
from protocol.replies import Actions, Welcome
from protocol.resuming import ResumingClient
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE, WELCOME
from tests.server.mortal import Mortal, episode, plain, resuming
from tests.server.serving import Served, costly_numbers, free_numbers, play, same, serve

FRAMES = range(20)
KINDS = {"context": {}, "memoryless": {"context_length": 1, "method": "rcbc"}, "conditioned": {"target_cost": 0.25}}
GAP = 17  # requests from one death to the next


@pytest.fixture(scope="module", params=sorted(KINDS))
def loaded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """Span 4 and 2 layers: a turn is felt for 6 more, and an episode has 27."""
    folder = tmp_path_factory.mktemp(request.param)
    return Bundle.load(make_bundle(folder, features=TABLE, action=WELCOME.action, budget=0.6, **KINDS[request.param]))


@pytest.fixture(scope="module")
def tiny(bundle: Path) -> Bundle:
    return Bundle.load(bundle)


def deaths(first: int, requests: int, moments: tuple[str, str]) -> dict[int, str]:
    return {cut: moments[n % 2] for n, cut in enumerate(range(first, requests, GAP))}


def test_wherever_it_dies_the_episode_is_the_same(loaded: Bundle) -> None:
    unbroken = Mortal(loaded, {})
    expected = episode(plain(unbroken), TABLE, FRAMES)
    for first in range(0, GAP, 5):
        for moments in (("before", "after"), ("after", "before")):
            mortal = Mortal(loaded, deaths(first, unbroken.requests, moments))
            client, n_deaths = resuming(mortal), len(mortal.deaths)
            assert episode(client, TABLE, FRAMES) == expected, (first, moments)
            assert (mortal.lives, client.resumed) == (n_deaths + 1, n_deaths)
            assert not mortal.deaths


def test_an_answer_that_a_death_held_up_is_late(tiny: Bundle) -> None:
    now_s = [0.0]

    def sleep(pause_s: float) -> None:
        now_s[0] += 5.0

    client = resuming(Mortal(tiny, {1: "before"}), clock=lambda: now_s[0], sleep=sleep)
    client.hello()
    bots, late = client.start(2, seeds=[1, 2]), []
    for frame in range(4):
        queries = client.query(bots, frame, free_numbers(TABLE, 2, frame), deadline_us=9e6)
        actions = client.act(bots, frame, queries.queries, costly_numbers(TABLE, 2, frame), deadline_us=9e6)
        late += [queries.late, actions.late]
    assert client.resumed == 1
    assert late == [False, True] + 6 * [False]
    assert client.n_late == 1


def test_turns_that_no_context_took_are_not_replayed(tiny: Bundle) -> None:
    """Whole messages that fell back, first and last ones too; then one bot's turns alone."""
    for broken in ({0: [0, 1, 2], 14: [0, 1, 2], 15: [0, 1, 2], 30: [0, 1, 2]}, {4: [1], 16: [0], 29: [2]}):
        unbroken = Mortal(tiny, {}, broken)
        expected = episode(plain(unbroken), TABLE, FRAMES)
        assert expected != episode(plain(Mortal(tiny, {})), TABLE, FRAMES)
        for first in (1, 9):
            mortal = Mortal(tiny, deaths(first, unbroken.requests, ("after", "before")), broken)
            assert episode(resuming(mortal), TABLE, FRAMES) == expected, (first, broken)


def test_one_turn_less_would_not_do(tiny: Bundle) -> None:
    """The number that welcome names is the least: the others see a context that was not rebuilt."""
    expected = episode(plain(Mortal(tiny, {})), TABLE, FRAMES)

    def differs(cut: int) -> bool:
        client = resuming(Mortal(tiny, {cut: "before"}))
        hello = client.hello

        def forgetful_hello(**said: object) -> Welcome:
            welcome = hello(**said)
            client._history._depth = welcome.replay_frames - 1
            return welcome

        client.hello = forgetful_hello
        return episode(client, TABLE, FRAMES) != expected

    assert any(differs(cut) for cut in range(54, 60))


def test_bots_that_stopped_stay_so_and_the_others_go_on(tiny: Bundle) -> None:
    def run(client: ResumingClient, mortal: Mortal) -> list[object]:
        client.hello()
        bots = client.start(4, seeds=[1, 2, 3, 4])
        played = play(client, TABLE, bots[:2], range(4)) + play(client, TABLE, bots[2:], range(4))
        assert client.stop(bots[:2]) == 2
        if mortal.deaths:
            mortal.deaths[mortal.requests] = "before"
        return played + play(client, TABLE, bots[2:], range(4, 12))

    unbroken, mortal = Mortal(tiny, {}), Mortal(tiny, {17: "after", 10**9: "before"})
    assert same(run(resuming(mortal), mortal), run(resuming(unbroken), unbroken))
    assert mortal.lives > 1


def test_requests_that_were_answered_before_a_death_are_answered_so_after_it(tiny: Bundle) -> None:
    mortal = Mortal(tiny, {})
    client = resuming(mortal)
    client.hello()
    bots, others = client.start(2, seeds=[1, 2]), client.start(1, seeds=[3])
    play(client, TABLE, bots, range(3))
    free, costly = free_numbers(TABLE, 2, 3), costly_numbers(TABLE, 2, 3)
    queries = client.query(bots, 3, free, [0.25, 0.25])
    mortal.deaths[mortal.requests] = "before"
    client.query(others, 0, free[:1])
    assert client.query(bots, 3, free, [0.25, 0.25]) is queries
    actions = client.act(bots, 3, queries.queries, costly)
    mortal.deaths[mortal.requests] = "before"
    client.query(others, 1, free[:1])
    assert client.act(bots, 3, queries.queries, costly) is actions
    rest = play(client, TABLE, bots, range(4, 8))

    unbroken = resuming(Mortal(tiny, {}))
    unbroken.hello()
    assert same([actions, *rest], play(unbroken, TABLE, unbroken.start(2, seeds=[1, 2]), range(8))[3:])


def test_refusals_come_through_and_change_nothing(tiny: Bundle) -> None:
    client = resuming(Mortal(tiny, {30: "before"}))
    with pytest.raises(NoConnection):
        client.start(1)
    client.hello()
    bots, none = client.start(2, seeds=[1, 2]), np.zeros((2, TABLE.n_queries), dtype=bool)
    played = []
    for frame in range(12):
        free, costly = free_numbers(TABLE, 2, frame), costly_numbers(TABLE, 2, frame)
        far = free + np.float32(1000.0)
        for refusal, refused in (
            (NoBot, partial(client.query, [7], frame, free[:1])),
            (NoPendingQuery, partial(client.act, bots, frame, none, costly)),
            (OutOfRange, partial(client.query, bots, frame, far, [5.0, 5.0])),
            (OutOfRange, partial(client.take, bots, frame, far, none, costly, [5.0, 5.0])),
        ):
            with pytest.raises(refusal):
                refused()
        played += play(client, TABLE, bots, range(frame, frame + 1))
    unbroken = resuming(Mortal(tiny, {}))
    unbroken.hello()
    assert same(played, play(unbroken, TABLE, unbroken.start(2, seeds=[1, 2]), range(12)))


def test_as_many_turns_may_be_under_way_as_there_are_bots(tiny: Bundle) -> None:
    """Each bot a company of its own: all are asked for before the first acts, and the server dies in between."""
    mortal = Mortal(tiny, {12: "before"})
    client, unbroken = resuming(mortal), resuming(Mortal(tiny, {}))
    acted: dict[int, list[Actions]] = {0: [], 1: []}
    for n, each in enumerate((client, unbroken)):
        each.hello()
        assert each.welcome.max_bots == 8
        bots = each.start(8, seeds=range(8))
        for frame in range(3):
            free, costly = free_numbers(TABLE, 1, frame), costly_numbers(TABLE, 1, frame)
            asked = [each.query([bot], frame, free) for bot in bots]
            acted[n] += [each.act([bot], frame, q.queries, costly) for bot, q in zip(bots, asked, strict=True)]
    assert client.resumed == 1
    for mine, theirs in zip(acted[0], acted[1], strict=True):
        assert same([mine], [theirs])
        assert mine.turns.tolist() == theirs.turns.tolist()


def test_it_gives_up_after_its_limit_and_can_be_asked_again(tiny: Bundle) -> None:
    mortal, now, pauses = Mortal(tiny, {2: "before"}), [0.0], []

    def pause(pause_s: float) -> None:
        pauses.append(pause_s)
        now[0] += pause_s

    client = ResumingClient("tcp://127.0.0.1:1", limit_s=3.0, clock=lambda: now[0], sleep=pause)
    client._client._transport = mortal
    client.hello()
    bots = client.start(1, seeds=[1])
    play(client, TABLE, bots, range(1))
    mortal.absence = 10**9

    with pytest.raises(ConnectionError):
        client.query(bots, 1, free_numbers(TABLE, 1, 1), [0.25])
    assert 3.0 <= sum(pauses) < 3.5
    assert sorted(pauses) == pauses
    mortal.absence = mortal.absent = 0
    unbroken = resuming(Mortal(tiny, {}))
    unbroken.hello()
    assert same(
        play(client, TABLE, bots, range(1, 6)), play(unbroken, TABLE, unbroken.start(1, seeds=[1]), range(6))[1:]
    )


def test_another_bundle_cannot_go_on(tiny: Bundle, tmp_path: Path) -> None:
    mortal = Mortal(tiny, {2: "before"})
    client = resuming(mortal)
    client.hello()
    bots = client.start(1)
    play(client, TABLE, bots, range(1))
    mortal.bundle = Bundle.load(make_bundle(tmp_path, features=TABLE, action=WELCOME.action, budget=0.6, seed=1))
    with pytest.raises(NoBot, match="another bundle"):
        client.query(bots, 1, free_numbers(TABLE, 1, 1))


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_a_line_that_is_cut_is_no_death(served: Served, door: str) -> None:
    """Over HTTP the connection lives on and nothing is replayed; a stream's bots ended with it and are rebuilt."""
    with ResumingClient(served.addresses[door]) as client, ResumingClient(served.addresses[door]) as unbroken:
        client.hello()
        unbroken.hello()
        bots, played = client.start(2, seeds=[1, 2]), []
        for frame in range(12):
            client._client._transport.close()
            played += play(client, TABLE, bots, range(frame, frame + 1))
        assert same(played, play(unbroken, TABLE, unbroken.start(2, seeds=[1, 2]), range(12)))
        assert client.resumed == (0 if door == "http" else 12)


def test_costs_are_learned_again_from_the_turns_that_are_replayed(tiny: Bundle) -> None:
    mortal = Mortal(tiny, {})
    client = resuming(mortal)
    client.hello()
    bots = client.start(2, seeds=[1, 2])

    def turns(frames: range) -> None:
        for frame in frames:
            query = client.query(bots, frame, free_numbers(TABLE, 2, frame)).queries
            client.act(bots, frame, query, costly_numbers(TABLE, 2, frame), acquire_us=40.0)

    turns(range(20))
    (before,) = mortal.handlers.costs()
    mortal.deaths[mortal.requests] = "before"
    turns(range(20, 21))
    (after,) = mortal.handlers.costs()
    depth = client.welcome.replay_frames
    assert client.resumed == 1
    assert before.frames > after.frames > 0
    assert after.frames <= depth + 1
    assert after.rows[0].declared_us == before.rows[0].declared_us


def test_a_server_that_is_too_busy_to_rebuild_is_asked_again(tiny: Bundle) -> None:
    """A replayed turn that no context took: once it comes out of the network as NaN, then no more."""
    broken: dict[int, list[int]] = {}
    mortal = Mortal(tiny, {}, broken)
    client, unbroken = resuming(mortal), resuming(Mortal(tiny, {}))
    for each in (client, unbroken):
        each.hello()
    bots, own = client.start(3, seeds=[1, 2, 3]), unbroken.start(3, seeds=[1, 2, 3])
    played = play(client, TABLE, bots, range(12))
    broken[10] = [0, 1, 2]
    mortal.deaths[mortal.requests] = "before"
    client._patience._sleep = lambda pause_s: broken.clear() if mortal.absent == 0 and client.resumed == 0 else None
    played += play(client, TABLE, bots, range(12, 16))
    assert same(played, play(unbroken, TABLE, own, range(16)))
    assert client.resumed == 1


@pytest.fixture(scope="module")
def impatient(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Its default deadline has always passed."""
    with serve(bundle, tmp_path_factory.mktemp("socket") / "s", default_deadline_us=0.001) as running:
        yield running


@pytest.mark.parametrize("door", ["tcp", "ws"])
def test_turns_of_before_have_no_deadline_where_the_server_has_a_default(impatient: Served, door: str) -> None:
    """Some turns are given their time, some the default, which no query or no step has; a line is cut at each half."""

    def run(client: ResumingClient, cut: Callable[[], None]) -> list[bytes]:
        client.hello()
        bots, played = client.start(2, seeds=[1, 2]), []
        for frame in range(12):
            free, costly = free_numbers(TABLE, 2, frame), costly_numbers(TABLE, 2, frame)
            ask_us, act_us = (None if frame % 5 == 3 else 1e9), (None if frame % 5 == 4 else 1e9)
            cut()
            query = client.query(bots, frame, free, [0.25, 0.25], deadline_us=ask_us)
            cut()
            actions = client.act(bots, frame, query.queries, costly, hidden=True, deadline_us=act_us)
            assert query.queries.any() or ask_us is None
            said = (query.queries, query.reasons, actions.actions, actions.reasons, actions.turns)
            played.append(b"".join(array.tobytes() for array in said))
        return played

    with ResumingClient(impatient.addresses[door]) as client, ResumingClient(impatient.addresses[door]) as unbroken:
        assert run(client, client._client._transport.close) == run(unbroken, lambda: None)
        assert (client.resumed, unbroken.resumed) == (24, 0)


def test_bots_whose_rewards_left_every_target_behind_go_on(tiny: Bundle) -> None:
    mortal, largest = Mortal(tiny, {6: "before"}), np.array([1e9], np.float32)
    client = resuming(mortal)
    client.hello()
    bots, everything = client.start(1), np.zeros((1, TABLE.n_costly), np.float32)
    for frame in range(4):
        asked = client.query(bots, frame, free_numbers(TABLE, 1, frame), largest).queries
        client.act(bots, frame, asked, everything)
    assert client.resumed == 1
