"""What is in memory: the active serving of a name, and earlier ones for as long as connections hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.work import finished
from protocol.codec import Format
from protocol.errors import NoBundle, TooManyBots, TooManyConnections
from protocol.messages import Goodbye, Hello, RequestQueries, StartBots, StopBots
from server.connections import Connections
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from tests.bundles import make_bundle
from tests.server.serving import FakeClock

FORM = Format.MSGPACK


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> list[Bundle]:
    """Three bundles of one name and one interface, with different weights."""
    folder = tmp_path_factory.mktemp("versions")
    return [Bundle.load(make_bundle(folder / str(seed), seed=seed)) for seed in range(3)]


def _served(*bundles: Bundle, max_bots: int = 8, clock: FakeClock | None = None) -> tuple[Handlers, Servings]:
    servings = Servings(max_bots)
    for bundle in bundles:
        servings.activate(Serving(bundle, max_bots=max_bots))
    return Handlers(servings, Connections(4, 60.0, clock or FakeClock()), None), servings


def test_a_new_connection_gets_the_active_one_and_an_old_one_keeps_its_own(versions: list[Bundle]) -> None:
    handlers, servings = _served(versions[0])
    old = servings.named(None)
    first = finished(handlers.steps(Hello(), None, FORM)).connection
    bots = finished(handlers.steps(StartBots(2, seeds=[1, 2]), first, FORM)).bots
    new = Serving(versions[1], max_bots=8)
    servings.activate(new)
    assert servings.named(None) is new
    assert set(servings) == {old, new}
    second = finished(handlers.steps(Hello(), None, FORM)).connection
    finished(handlers.steps(StartBots(1), second, FORM))
    assert (old.bots.n_bots, new.bots.n_bots, servings.n_bots) == (2, 1, 3)
    free = np.zeros((2, old.table.n_free), dtype="<f4").tobytes()
    finished(handlers.steps(RequestQueries(0, bots, free), first, FORM))
    finished(handlers.steps(StopBots(bots), first, FORM))
    assert set(servings) == {old, new}
    finished(handlers.steps(Goodbye(), first, FORM))
    assert set(servings) == {new}


def test_an_old_one_is_forgotten_with_its_last_connection_however_that_ends(versions: list[Bundle]) -> None:
    clock = FakeClock()
    handlers, servings = _served(versions[0], clock=clock)
    silent, closed = (finished(handlers.steps(Hello(), None, FORM)).connection for _ in range(2))
    finished(handlers.steps(StartBots(3), silent, FORM))
    servings.activate(Serving(versions[1], max_bots=8))
    handlers.end(closed)
    handlers.end(closed)
    assert len(list(servings)) == 2
    clock.now += 61.0
    handlers.end_silent()
    assert [serving.bots.bundle for serving in servings] == [versions[1]]
    assert servings.n_bots == 0


def test_hello_keeps_the_version_that_it_names_though_who_held_it_is_swept(versions: list[Bundle]) -> None:
    """As when a client comes back for its bots after its time to live, and another version is active."""
    clock = FakeClock()
    handlers, servings = _served(clock=clock)
    old = Serving(versions[0], max_bots=8, version=1)
    servings.activate(old)
    silent = finished(handlers.steps(Hello(), None, FORM)).connection
    finished(handlers.steps(StartBots(2), silent, FORM))
    servings.activate(Serving(versions[1], max_bots=8, version=2))
    clock.now += 61.0
    back = finished(handlers.steps(Hello(bundle=f"{old.name}@{old.version}"), None, FORM)).connection
    finished(handlers.steps(StartBots(3), back, FORM))
    assert (len(list(servings)), servings.n_bots, old.n_connections) == (2, 3, 1)
    finished(handlers.steps(Goodbye(), back, FORM))
    assert (len(list(servings)), servings.n_bots, old.n_connections) == (1, 0, 0)


def test_a_hello_that_finds_no_room_holds_nothing(versions: list[Bundle]) -> None:
    handlers, servings = _served(versions[0])
    for _ in range(4):
        finished(handlers.steps(Hello(), None, FORM))
    with pytest.raises(TooManyConnections):
        finished(handlers.steps(Hello(), None, FORM))
    assert servings.named(None).n_connections == len(handlers.connections) == 4


def test_one_that_nobody_holds_is_forgotten_when_it_is_replaced(versions: list[Bundle]) -> None:
    _, servings = _served(*versions)
    assert [serving.bots.bundle for serving in servings] == [versions[2]]


def test_one_that_is_still_held_becomes_active_again(versions: list[Bundle]) -> None:
    handlers, servings = _served(versions[0])
    first, second = servings.named(None), Serving(versions[1], max_bots=8)
    connection = finished(handlers.steps(Hello(), None, FORM)).connection
    servings.activate(second)
    servings.activate(first)
    assert list(servings) == [first]
    handlers.end(connection)
    servings.activate(first)
    assert list(servings) == [first] == [servings.named(None)]


def test_max_bots_counts_the_bots_of_all_of_them(versions: list[Bundle]) -> None:
    handlers, servings = _served(versions[0], max_bots=3)
    first = finished(handlers.steps(Hello(), None, FORM)).connection
    finished(handlers.steps(StartBots(2), first, FORM))
    servings.activate(Serving(versions[1], max_bots=3))
    second = finished(handlers.steps(Hello(), None, FORM)).connection
    with pytest.raises(TooManyBots, match="2 bots do not fit: 2 of 3"):
        finished(handlers.steps(StartBots(2), second, FORM))
    finished(handlers.steps(StartBots(1), second, FORM))
    with pytest.raises(TooManyBots):
        finished(handlers.steps(StartBots(1), first, FORM))


def test_the_longest_message_is_that_of_whatever_is_in_memory(versions: list[Bundle], serving: Serving) -> None:
    _, servings = _served(versions[0], max_bots=8)
    small, large = serving.max_body_bytes, servings.named(None).max_body_bytes
    assert all(small[form] < large[form] == servings.max_body_bytes[form] for form in Format)
    servings.activate(serving)
    assert servings.max_body_bytes == small
    assert servings.max_hello_bytes == serving.max_hello_bytes


def test_a_connection_without_bots_starts_the_next_ones_on_the_active_version(versions: list[Bundle]) -> None:
    servings = Servings(8)
    servings.activate(Serving(versions[0], max_bots=8, version=1))
    handlers = Handlers(servings, Connections(4, 60.0, FakeClock()), None)
    hello = finished(handlers.steps(Hello(bundle="tiny"), None, FORM))
    pinned = finished(handlers.steps(Hello(bundle="tiny@1"), None, FORM)).connection
    assert (hello.bundle_version, hello.bundle_sha256) == (1, versions[0].sha256)
    bots = finished(handlers.steps(StartBots(2), hello.connection, FORM)).bots
    servings.activate(Serving(versions[1], max_bots=8, version=2))
    beside = finished(handlers.steps(StartBots(1), hello.connection, FORM))
    assert beside.bundle_version == 1
    finished(handlers.steps(StopBots([*bots, *beside.bots]), hello.connection, FORM))
    with pytest.raises(TooManyBots):
        finished(handlers.steps(StartBots(9), hello.connection, FORM))
    started = finished(handlers.steps(StartBots(2), hello.connection, FORM))
    assert (started.bundle_version, started.bundle_sha256) == (2, versions[1].sha256)
    assert finished(handlers.steps(StartBots(1), pinned, FORM)).bundle_version == 1
    handlers.end(pinned)
    assert [serving.version for serving in servings] == [2]


def test_a_version_that_breaks_what_welcome_said_is_for_new_connections_only(tmp_path: Path) -> None:
    """The same features and action, but another default budget."""
    servings = Servings(8)
    for version, budget in ((1, 0.5), (2, 0.25)):
        made = Bundle.load(make_bundle(tmp_path / str(version), budget=budget))
        if version == 2:
            handlers = Handlers(servings, Connections(4, 60.0, FakeClock()), None)
            old = finished(handlers.steps(Hello(), None, FORM))
        servings.activate(Serving(made, max_bots=8, version=version))
    assert finished(handlers.steps(StartBots(1), old.connection, FORM)).bundle_version == 1
    assert finished(handlers.steps(Hello(), None, FORM)).bundle_version == 2


def test_bundles_are_found_by_name_and_by_version_in_memory(versions: list[Bundle], tmp_path: Path) -> None:
    servings = Servings(8)
    one, two = (Serving(bundle, max_bots=8, version=n) for n, bundle in enumerate(versions[:2], 1))
    other = Serving(Bundle.load(make_bundle(tmp_path, name="other")), max_bots=8)
    with pytest.raises(NoBundle):
        servings.named(None)
    servings.activate(one)
    assert servings.named(None) is servings.named("tiny") is servings.named("tiny@1") is one
    servings.hold(one)
    servings.activate(two)
    servings.activate(other)
    assert (servings.named("tiny"), servings.named("tiny@1"), servings.named("tiny@2")) == (two, one, two)
    assert servings.named("other") is other
    with pytest.raises(NoBundle, match="name one of other, tiny"):
        servings.named(None)
    for wrong in ("tiny@3", "tiny@01", "tiny@1\n", "tiny@", "", "other@1", "TINY"):
        with pytest.raises(NoBundle):
            servings.named(wrong)
    servings.release(one)
    with pytest.raises(NoBundle):
        servings.named("tiny@1")
