from __future__ import annotations

import numpy as np
import pytest

from protocol.errors import NoBot, NoConnection, TooManyConnections
from protocol.features import CostModel
from server.connections import Connections
from server.serving import Serving
from tests.server.serving import FakeClock

COSTS = CostModel(0.0, (1.0,))


def test_a_request_that_is_refused_breaks_the_silence_and_one_that_comes_too_late_does_not(serving: Serving) -> None:
    clock = FakeClock()
    connections = Connections(max_connections=3, idle_ttl_s=10.0, clock=clock)
    talking, late = connections.open(COSTS, serving), connections.open(COSTS, serving)
    clock.now += 9.0
    assert connections.heard(talking.id) is talking
    clock.now += 9.0
    assert connections.heard(talking.id) is talking
    for _ in range(2):
        assert connections.heard(late.id) is None
    assert connections.silent() == [late]
    assert connections.heard(None) is None


def test_silence_is_measured_by_the_given_clock_and_any_request_breaks_it(serving: Serving) -> None:
    clock = FakeClock()
    connections = Connections(max_connections=3, idle_ttl_s=10.0, clock=clock)
    silent, talking = connections.open(COSTS, serving), connections.open(COSTS, serving)
    for _ in range(5):
        clock.now += 6.0
        assert connections.get(talking.id) is talking
    with pytest.raises(NoConnection):
        connections.get(silent.id)
    assert connections.silent() == [silent]
    connections.remove(silent.id)
    assert connections.silent() == []
    assert len(connections) == 1


def test_limits_and_names(serving: Serving) -> None:
    connections = Connections(max_connections=1, idle_ttl_s=10.0, clock=FakeClock())
    only = connections.open(COSTS, serving)
    with pytest.raises(TooManyConnections):
        connections.open(COSTS, serving)
    for name in (None, "", "0" * 32, only.id.upper() + "x"):
        with pytest.raises(NoConnection):
            connections.get(name)
    assert connections.remove(only.id) is only
    assert connections.remove(only.id) is None
    assert connections.open(COSTS, serving).id != only.id


def test_the_last_query_is_known_by_what_was_sent_of_it(serving: Serving) -> None:
    connection = Connections(1, 10.0, FakeClock()).open(COSTS, serving)
    query_NM = np.array([[True, False], [False, True]])
    assert connection.query_of(b"\x01\x02", 2) is None
    connection.asked = b"\x01\x02", query_NM
    assert connection.query_of(b"\x01\x02", 2) is query_NM
    for packed, n_bots in ((b"\x01\x00", 2), (b"\x01\x02", 1), ([[1, 0], [0, 1]], 2)):
        assert connection.query_of(packed, n_bots) is None


def test_names_begin_with_the_process_that_holds_them(serving: Serving) -> None:
    """And are as unguessable as any."""
    connections = Connections(2, 10.0, FakeClock(), process="p1")
    one, other = connections.open(COSTS, serving), connections.open(COSTS, serving)
    assert one.id.startswith("p1-")
    assert len(one.id) == len("p1-") + 32
    assert one.id != other.id
    assert connections.get(one.id) is one
    with pytest.raises(NoConnection):
        connections.get(one.id.removeprefix("p1-"))


def test_a_connection_names_its_own_bots(serving: Serving) -> None:
    connection = Connections(1, 10.0, FakeClock()).open(COSTS, serving)
    connection.bots.update({3, 4})
    connection.check_owns([4, 3])
    with pytest.raises(NoBot, match="5"):
        connection.check_owns([3, 5])
