"""Handles and slots: never another bot's state."""

from __future__ import annotations

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol import errors
from tests.bot_runtime.conftest import Engine


def test_handles_are_never_used_again(engine: Engine) -> None:
    seen: set[int] = set()
    for _ in range(20):
        handles = engine.bots.start(3)
        assert not seen & set(handles.tolist())
        assert (handles >= 0).all()
        seen |= set(handles.tolist())
        assert engine.bots.stop(handles) == 3
        with pytest.raises(errors.NoBot):
            engine.bots.stop(handles)


def test_handles_of_an_earlier_process_are_unknown(bundle: Bundle) -> None:
    before, after = (Bots(bundle, max_bots=2, first_generation=generation) for generation in (7, 8))
    after.start(2)
    with pytest.raises(errors.NoBot):
        Engine(after).ask(before.start(2), 0)


def test_processes_differ_in_their_first_generation(bundle: Bundle) -> None:
    assert Bots(bundle, max_bots=1).start(1) != Bots(bundle, max_bots=1).start(1)


def test_generations_wrap_within_63_bits(bundle: Bundle) -> None:
    bots = Bots(bundle, max_bots=1, first_generation=2**31 - 1)
    first = bots.start(1)
    bots.stop(first)
    assert 0 <= int(bots.start(1)[0]) < int(first[0]) < 2**63


def test_a_full_house_refuses_and_stays_as_it_is(engine: Engine) -> None:
    handles = engine.bots.start(6)
    with pytest.raises(errors.TooManyBots) as refusal:
        engine.bots.start(3)
    assert refusal.value.retry_after_s
    assert engine.bots.n_bots == 6
    engine.bots.start(2)
    assert engine.bots.n_bots == engine.bots.max_bots == 8
    engine.turn(handles, 0)


def test_a_freed_slot_is_zeroed(engine: Engine) -> None:
    handles = engine.bots.start(8)
    engine.play(handles, range(9))
    engine.bots.stop(handles)
    contexts = engine.bots._contexts
    arrays = {**vars(contexts), **vars(contexts._rows)}
    kept = {name: array for name, array in arrays.items() if isinstance(array, np.ndarray) and name != "_outputs"}
    assert len(kept) == 4 + 7
    assert not any(array.any() for array in kept.values())
    spending = {name: array for name, array in vars(engine.bots._spending).items() if isinstance(array, np.ndarray)}
    assert len(spending) == 5
    assert not any(array.any() for array in spending.values())
    engine.turn(engine.bots.start(8), 0)  # an earlier frame than the slots' last bots saw


def test_a_stopped_bot_ends_a_pending_query_for_all_its_bots(engine: Engine) -> None:
    handles = engine.bots.start(3)
    queries = engine.ask(handles, 0)
    engine.bots.stop(handles[:1])
    with pytest.raises(errors.NoBot):
        engine.submit(handles, 0, queries)
    with pytest.raises(errors.NoPendingQuery):
        engine.bots.submit_features(handles[1:], 0, queries.query_NM[1:], engine.costly(0, 2))
    engine.turn(handles[1:], 1)
