"""Turns of several engines taken together: what each gets is what it would have got alone, refusals included."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bot_runtime.batch import Batch
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.together import BOUNDS, MAX_BOTS_EACH
from bot_runtime.turns import Actions, Queries
from bot_runtime.work import Steps, finished
from protocol.errors import ProtocolError
from tests.bot_runtime.conftest import Engine

CAPACITY = 24
PARTS = st.lists(st.integers(1, MAX_BOTS_EACH + 2), min_size=2, max_size=4).filter(lambda sizes: sum(sizes) <= CAPACITY)
MOVES = st.just("on") | st.sampled_from(["on", "turn", "nan", "again", "stale", "gone", "much"])
ROUNDS = st.lists(
    st.lists(st.tuples(st.integers(0, 3), MOVES), min_size=1, max_size=4, unique_by=itemgetter(0)), max_size=6
)


def told(steps: Steps[Any]) -> Steps[Any]:
    """What it comes to, or the code it was refused with."""
    try:
        return (yield from steps)
    except ProtocolError as error:
        return error.code


class Played(NamedTuple):
    """One engine's move, made of its bots in one of the twins."""

    kind: str
    handles: np.ndarray
    frame: int
    pending: Queries | None


def steps_of(engine: Engine, move: Played) -> Steps[Any]:
    bots, n_bots, frame = engine.bots, move.handles.size, move.frame
    handles = move.handles + 2**32 if move.kind == "gone" else move.handles  # of another generation
    frame = {"stale": 0, "again": frame - 1}.get(move.kind, frame)
    free = engine.free(frame, n_bots)
    if move.kind == "nan":
        free[-1, -1] = np.nan
    if move.kind == "turn":
        acquired = np.zeros((n_bots, engine.table.n_queries), dtype=bool)
        acquired[:, 0] = True
        costly = np.where(acquired[:, engine.table.owner], engine.costly(frame, n_bots), np.float32(0.0))
        return bots.turn_steps(handles, frame, free, acquired, costly)
    if move.pending is None or move.kind in ("nan", "stale", "again"):
        return bots.query_steps(handles, frame, free, engine.rewards(frame, n_bots))
    query = np.ones_like(move.pending.query_NM) if move.kind == "much" else move.pending.query_NM
    return bots.feature_steps(handles, frame, query, engine.costly(frame, n_bots))


def check_same(joined: Any, alone: Any) -> None:
    assert type(joined) is type(alone), (joined, alone)
    if isinstance(alone, str):
        assert joined == alone
        return
    for name, expected in alone._asdict().items():
        if name in ("probs_NM", "action_NA"):
            np.testing.assert_allclose(getattr(joined, name), expected, atol=1e-5)
        elif name != "infer_us":
            np.testing.assert_array_equal(getattr(joined, name), expected)


def parted(handles: np.ndarray, sizes: list[int], order: list[int] | None) -> list[np.ndarray]:
    """Each engine's bots, side by side in the arena or, by an `order`, anywhere."""
    mixed = handles if order is None else handles[order]
    return np.split(mixed[: sum(sizes)], np.cumsum(sizes)[:-1])


@settings(max_examples=40, deadline=None)
@given(PARTS, st.none() | st.permutations(list(range(CAPACITY))), ROUNDS)
def test_any_interleaving_is_the_same_as_one_by_one(
    bundle: Bundle, sizes: list[int], order: list[int] | None, rounds: list[list[tuple[int, str]]]
) -> None:
    twins = [Engine(Bots(bundle, max_bots=CAPACITY, first_generation=7)) for _ in range(2)]
    engines = [parted(twin.bots.start(CAPACITY), sizes, order) for twin in twins]
    frames, pending = [1] * len(sizes), [None] * len(sizes)
    for moves in rounds:
        moves = [(i, kind) for i, kind in moves if i < len(sizes)]
        begun = [
            [told(steps_of(twin, Played(kind, theirs[i], frames[i], pending[i]))) for i, kind in moves]
            for twin, theirs in zip(twins, engines, strict=True)
        ]
        joined = twins[0].bots.together.finished(begun[0])
        alone = [finished(steps) for steps in begun[1]]
        for (i, kind), one, other in zip(moves, joined, alone, strict=True):
            check_same(one, other)
            if isinstance(other, Queries) and kind not in ("again", "gone"):
                pending[i] = other
            elif isinstance(other, Actions) and kind != "gone":
                frames[i], pending[i] = frames[i] + 1, None
    for i, (handles, other_handles) in enumerate(zip(*engines, strict=True)):  # nothing else was left behind either
        np.testing.assert_allclose(twins[0].bots.hidden(handles), twins[1].bots.hidden(other_handles), atol=1e-5)
        check_same(twins[0].turn(handles, frames[i] + 1), twins[1].turn(other_handles, frames[i] + 1))


@pytest.fixture
def three(bundle: Bundle) -> tuple[Engine, list[np.ndarray]]:
    engine = Engine(Bots(bundle, max_bots=6))
    return engine, [engine.bots.start(2) for _ in range(3)]


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0], [1, 2], [2, 1, 0], [0]])
def test_bots_that_lie_side_by_side_or_not_act_as_alone(
    three: tuple[Engine, list[np.ndarray]], order: list[int], bundle: Bundle
) -> None:
    engine, handles = three
    twin = Engine(Bots(bundle, max_bots=6))
    others = [twin.bots.start(2) for _ in range(3)]
    for frame in range(1, 5):
        queries = engine.bots.together.finished(
            [told(engine.bots.query_steps(handles[i], frame, engine.free(frame + i, 2))) for i in order]
        )
        submitted = zip(order, queries, strict=True)
        actions = engine.bots.together.finished(
            [
                told(engine.bots.feature_steps(handles[i], frame, q.query_NM, engine.costly(frame + i, 2)))
                for i, q in submitted
            ]
        )
        for i, query, action in zip(order, queries, actions, strict=True):
            expected = twin.bots.request_queries(others[i], frame, twin.free(frame + i, 2))
            check_same(query, expected)
            check_same(
                action, twin.bots.submit_features(others[i], frame, expected.query_NM, twin.costly(frame + i, 2))
            )


def asked(engine: Engine, handles: list[np.ndarray], frame: int) -> list[Steps[Any]]:
    return [told(engine.bots.query_steps(each, frame, engine.free(frame, 2))) for each in handles]


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0], [1, 2], [2, 1, 0]])
def test_the_graph_runs_once_for_all(
    three: tuple[Engine, list[np.ndarray]], order: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, handles = three
    sizes, run = [], engine.bots._policy.query_probs

    def counted(batch: Batch) -> None:
        sizes.append(batch.n_bots)
        run(batch)

    monkeypatch.setattr(engine.bots._policy, "query_probs", counted)
    engine.bots.together.finished(asked(engine, [handles[i] for i in order], 1))
    assert sizes == [2 * len(order)]
    assert engine.bots.together.n_batches == len(order)
    assert engine.bots.together.counts == [len(order) <= 2, len(order) > 2] + [0] * (len(BOUNDS) - 1)


def test_a_graph_that_fails_fails_in_each_and_changes_nothing(
    three: tuple[Engine, list[np.ndarray]], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, handles = three

    def fail(_: Batch) -> None:
        raise MemoryError

    def caught(steps: Steps[Any]) -> Steps[Any]:
        try:
            return (yield from steps)
        except MemoryError:
            return "failed"

    with monkeypatch.context() as broken:
        broken.setattr(engine.bots._policy, "query_probs", fail)
        assert engine.bots.together.finished([caught(each) for each in asked(engine, handles, 1)]) == ["failed"] * 3
    again = engine.bots.together.finished(asked(engine, handles, 1))
    assert all(isinstance(each, Queries) for each in again)
    assert engine.bots.together.n_batches == 3


def test_a_spoilt_output_is_of_its_own_bot_alone(
    three: tuple[Engine, list[np.ndarray]], monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, handles = three
    run: Callable[[Batch], None] = engine.bots._policy.query_probs

    def spoilt(batch: Batch) -> None:
        run(batch)
        batch.probs_NM[3] = np.nan

    monkeypatch.setattr(engine.bots._policy, "query_probs", spoilt)
    replies = engine.bots.together.finished(asked(engine, handles, 1))
    reasons = [reply.reasons_N for reply in replies]
    assert reasons[0] is None
    assert (reasons[1] > 0).tolist() == [False, True]
    assert reasons[2] is None
