"""Bots that are named together: what is remembered of them is what would be worked out again."""

from __future__ import annotations

import numpy as np
import pytest

from bot_runtime import company as company_module
from bot_runtime.bots import Bots
from bot_runtime.budget import allocate
from bot_runtime.bundle import Bundle
from bot_runtime.company import Means
from bot_runtime.spending import Terms
from protocol import errors
from tests.bot_runtime.conftest import Engine


@pytest.mark.parametrize("shared", [False, True])
def test_what_fits_is_what_allocate_leaves(shared: bool) -> None:
    """Budgets of nothing, of less than is sampled, of just as much, of an ulp more, and of any amount."""
    random, bound = np.random.default_rng(0), 0
    for _ in range(300):
        n_bots, n_queries = random.integers(1, 6), random.integers(1, 9)
        costs, calls = random.random((n_bots, n_queries)), random.choice([0.0, 0.7], n_bots)
        probs = random.random((n_bots, n_queries)).astype(np.float32)
        sampled = random.random((n_bots, n_queries)) < random.random()
        exact = np.where(sampled, costs, 0.0).sum(axis=1) + np.where(sampled.any(axis=1), calls, 0.0)
        budgets = exact * random.choice([0.0, 0.5, 1.0, 1.0 + 1e-15, 1.0 + 1e-7, 3.0], n_bots)
        budgets[random.random(n_bots) < 0.3] = np.inf
        frame = float(exact.sum() * random.choice([0.0, 0.5, 1.0, 1.0 + 1e-7, 2.0])) if shared else None
        means = Means.of(Terms(costs, calls, budgets, costs.sum(axis=1) + calls, np.zeros(n_bots, dtype=np.float32)))
        expected = allocate(probs, sampled, costs, calls, budgets, frame)
        query, cost_us = means.fit(probs, sampled.copy(), frame)
        assert np.array_equal(query, expected)
        np.testing.assert_allclose(cost_us, (query * costs).sum(axis=1) + query.any(axis=1) * calls)
        bound += not np.array_equal(expected, sampled)
    assert 30 < bound < 270


def test_companies_come_and_go(bundle: Bundle, monkeypatch: pytest.MonkeyPatch) -> None:
    """Play in more orders than are remembered is play without any memory, byte for byte."""
    plays = []
    for times in (1, 3, company_module.ORDERS):
        monkeypatch.setattr(company_module, "ORDERS", times)
        engine, orders = Engine(Bots(bundle, max_bots=6)), np.random.default_rng(1)
        handles, played = engine.bots.start(6, seeds=range(6)), []
        for frame in range(40):
            named = orders.permutation(handles)[: orders.integers(1, 7)] if frame % 3 else handles
            played += engine.play(named, range(frame, frame + 1))
            known = engine.bots._companies._known.values()
            assert len(known) <= 6
            assert sum(each.n_bots for each in known) <= times * 6
        plays.append(played)
    assert plays[0] == plays[1] == plays[2]


def test_bytes_that_look_like_handles_are_not(engine: Engine) -> None:
    handles = engine.bots.start(2)
    engine.turn(handles, 0)
    for other in (handles.view(np.float64), handles.view(np.uint64), handles[None]):
        with pytest.raises(errors.BadShape, match="bots are"):
            engine.bots.request_queries(other, 1, engine.free(1, 2))


def test_a_stopped_bots_company_is_forgotten(engine: Engine) -> None:
    handles = engine.bots.start(3)
    for frame, named in enumerate((handles, handles[:1], handles[1:])):
        engine.turn(named, frame)
    engine.bots.stop(handles[:1])
    assert list(engine.bots._companies._known) == [handles[1:].tobytes()]
    for named in (handles, handles[:1]):
        with pytest.raises(errors.NoBot):
            engine.turn(named, 50)
