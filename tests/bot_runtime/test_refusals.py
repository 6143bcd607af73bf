"""Whatever is refused says what was wrong, and changes nothing."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol import errors
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine


def refusals(
    engine: Engine, handles: np.ndarray, frame: int
) -> list[tuple[type[Exception], str, Callable[[], object]]]:
    """Everything that can be refused for bots whose last answered frame is `frame` - 1."""
    bots, n_bots = engine.bots, handles.size
    free = engine.free(frame, n_bots)

    def spoil(row: int, column: int, number: float) -> np.ndarray:
        spoilt = free.copy()
        spoilt[row, column] = number
        return spoilt

    def ask(
        free: np.ndarray = free, at: int = frame, of: np.ndarray = handles, **options: object
    ) -> Callable[[], object]:
        return lambda: bots.request_queries(of, at, free, **options)

    gone, bot = handles[:1] + (1 << 32), f"bot {handles[1]}"
    return [
        (errors.NonFinite, f"goal of {bot} is nan", ask(spoil(1, 4, math.nan))),
        (errors.NonFinite, f"position of {bot} is inf", ask(spoil(1, 0, math.inf))),
        (errors.OutOfRange, f"goal of {bot} is 1.5, expected -1 to 1", ask(spoil(1, 3, 1.5))),
        (errors.BadShape, "free is float32", ask(free[:, 1:])),
        (errors.BadShape, "free is float64", ask(free.astype(np.float64))),
        (errors.BadShape, "rewards has shape", ask(rewards_N=[0.0])),
        (errors.NonFinite, "rewards of bot 1", ask(rewards_N=[0.0, math.nan])),
        (errors.OutOfRange, "rewards of bot 0", ask(rewards_N=[1e300, 0.0])),
        (errors.NonFinite, "frame_budget_us", ask(frame_budget_us=math.nan)),
        (errors.OutOfRange, "frame_budget_us", ask(frame_budget_us=-1.0)),
        (errors.BadShape, "budgets_us has shape", ask(budgets_us=[1.0])),
        (errors.OutOfRange, "budgets_us of bot 1", ask(budgets_us=[1.0, 1.1e9])),
        (errors.NonFinite, "budgets_us of bot 0", ask(budgets_us=[math.inf, 1.0])),
        (errors.BadShape, "target_costs_us has shape", ask(target_costs_us=[1.0] * 3)),
        (errors.OutOfRange, "target_costs_us of bot 0", ask(target_costs_us=[-1.0, 1.0])),
        (errors.NonFinite, "target_costs_us of bot 1", ask(target_costs_us=[1.0, math.nan])),
        (errors.BadSchema, "frame is -1", ask(at=-1)),
        (errors.StaleFrame, "frame 0", ask(at=0)),
        (errors.FrameReused, "other content", ask(spoil(0, 0, 0.25), at=frame - 1)),
        (errors.FrameReused, "other bots", ask(free[:1], at=frame - 1, of=handles[:1])),
        (errors.FrameReused, "other bots", ask(at=frame - 1, of=handles[::-1])),
        (errors.BadSchema, "more than once", ask(of=handles[[0, 0]])),
        (errors.BadShape, "bots are", ask(of=handles[:0])),
        (errors.BadShape, "bots are", ask(of=handles.astype(np.float64))),
        (errors.NoBot, "unknown or was stopped", ask(free[:1], of=gone)),
        (errors.NoBot, "unknown or was stopped", ask(free[:1], of=np.array([-1]))),
        (errors.NoBot, "unknown or was stopped", lambda: bots.stop(np.concatenate([handles, gone]))),
        (errors.BadSchema, "more than once", lambda: bots.stop(handles[[1, 1]])),
        (errors.NoPendingQuery, "does not fit", lambda: _submit_nothing(engine, handles, frame)),
        (errors.StaleFrame, "does not fit", lambda: _submit_nothing(engine, handles, 0)),
        (errors.FrameReused, "other content", lambda: _submit_changed(engine, handles, frame - 1)),
        (errors.NoPendingQuery, "exactly these bots", lambda: _submit_nothing(engine, handles[::-1], frame - 1)),
        (errors.NoPendingQuery, "exactly these bots", lambda: _submit_nothing(engine, handles[:1], frame - 1)),
    ]  # fmt: skip


def start_refusals(bots: Bots) -> list[tuple[type[Exception], str, Callable[[], object]]]:
    """Everything that can be refused to bots that are to start."""
    return [
        (errors.TooManyBots, "slots are taken", lambda: bots.start(8)),
        (errors.TooManyBots, "never fit", lambda: bots.start(100)),
        (errors.BadSchema, "count is 0", lambda: bots.start(0)),
        (errors.BadShape, "seeds has 1", lambda: bots.start(2, seeds=[1])),
        (errors.OutOfRange, "seed of bot 0", lambda: bots.start(1, seeds=[-1])),
        (errors.NonFinite, "target_returns", lambda: bots.start(1, target_returns=[math.inf])),
        (errors.OutOfRange, "budgets_us", lambda: bots.start(1, budgets_us=[-0.5])),
        (errors.NonFinite, "budgets_us", lambda: bots.start(1, budgets_us=[math.nan])),
        (errors.BadShape, "target_costs_us", lambda: bots.start(2, target_costs_us=[1.0])),
        (errors.OutOfRange, "target_costs_us", lambda: bots.start(1, target_costs_us=[1.1e9])),
        (errors.NonFinite, "target_costs_us", lambda: bots.start(1, target_costs_us=[math.nan])),
        (errors.BadShape, "cost_model", lambda: bots.start(1, cost_model=CostModel(0.0, (1.0,)))),
    ]  # fmt: skip


def submit_refusals(
    engine: Engine, handles: np.ndarray, frame: int, query: np.ndarray
) -> list[tuple[type[Exception], str, Callable[[], object]]]:
    """Everything that can be refused while `query` is pending for these bots."""
    costly, table = engine.costly(frame, handles.size), engine.table
    asked, unasked = (np.argwhere(bits)[0] for bits in (query, ~query))
    names = [feature.name for feature in table.costly]

    def flip(at: np.ndarray, bits: np.ndarray) -> np.ndarray:
        flipped = bits.copy()
        flipped[tuple(at)] ^= True
        return flipped

    def spoil(number: float) -> np.ndarray:
        spoilt = costly.copy()
        spoilt[asked[0], np.argmax(table.owner == asked[1])] = number
        return spoilt

    def submit(
        acquired: np.ndarray = query, values: np.ndarray = costly, failed: np.ndarray | None = None
    ) -> Callable[[], object]:
        return lambda: engine.bots.submit_features(handles, frame, acquired, values, failed)

    none = np.zeros_like(query)
    where_asked, where_unasked = (f"{names[at[1]]} of bot {handles[at[0]]}" for at in (asked, unasked))
    return [
        (errors.UnrequestedFeature, where_unasked, submit(flip(unasked, query))),
        (errors.UnrequestedFeature, where_unasked, submit(failed=flip(unasked, none))),
        (errors.MissingFeature, where_asked, submit(flip(asked, query))),
        (errors.NonFinite, where_asked, submit(values=spoil(math.nan))),
        (errors.NonFinite, where_asked, submit(values=spoil(-math.inf))),
        (errors.OutOfRange, where_asked, submit(values=spoil(1e7))),
        (errors.BadShape, "values is", submit(values=costly[:, 1:])),
        (errors.BadShape, "acquired is", submit(query[:1])),
        (errors.BadShape, "acquired is", submit(query.astype(np.uint8))),
        (errors.BadShape, "failed is", submit(failed=none[:, 1:])),
    ]  # fmt: skip


def _submit_nothing(engine: Engine, handles: np.ndarray, frame: int) -> object:
    none = np.zeros((handles.size, engine.table.n_queries), dtype=np.bool_)
    return engine.bots.submit_features(
        handles, frame, none, np.zeros((handles.size, engine.table.n_costly), np.float32)
    )


def _submit_changed(engine: Engine, handles: np.ndarray, frame: int) -> object:
    queries = engine.ask(handles, frame)
    return engine.bots.submit_features(handles, frame, queries.query_NM, engine.costly(frame, handles.size) * 0.5)


def test_after_any_refusal_the_next_20_turns_are_byte_identical(bundle: Bundle) -> None:
    """THREATS: a refused request leaves the bots exactly as they were, wherever in a turn it comes."""
    clean = Engine(Bots(bundle, max_bots=8))
    expected = clean.play(clean.bots.start(2), range(26))
    engine = Engine(Bots(bundle, max_bots=8))
    handles = engine.bots.start(2)
    assert engine.play(handles, range(4)) == expected[:4]
    for error, match, call in [*refusals(engine, handles, 4), *start_refusals(engine.bots)]:
        with pytest.raises(error, match=match):
            call()
    queries = engine.ask(handles, 4)
    assert queries.query_NM.any()
    for error, match, call in submit_refusals(engine, handles, 4, queries.query_NM):
        with pytest.raises(error, match=match):
            call()
    engine.submit(handles, 4, queries)
    assert engine.play(handles, range(5, 26)) == expected[5:]
    assert engine.bots.n_bots == 2


def test_a_failing_policy_changes_nothing(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    clean, engine = Engine(Bots(bundle, max_bots=8)), Engine(Bots(bundle, max_bots=8))
    expected = clean.play(clean.bots.start(2), range(12))
    handles = engine.bots.start(2)
    played = engine.play(handles, range(3))

    def fail(*_: object) -> None:
        raise RuntimeError("out of memory")

    with monkeypatch.context() as broken:
        broken.setattr(engine.bots._policy, "query_probs", fail)
        with pytest.raises(RuntimeError):
            engine.ask(handles, 3)
    queries = engine.ask(handles, 3)
    with monkeypatch.context() as broken:
        broken.setattr(engine.bots._policy, "act", fail)
        with pytest.raises(RuntimeError):
            engine.submit(handles, 3, queries)
    assert played + engine.play(handles, range(3, 12)) == expected
