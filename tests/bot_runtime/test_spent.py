"""Budgets allowed, costs asked for and costs measured: each frame once, whatever is repeated or refused."""

from __future__ import annotations

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.costs import Costs
from protocol.errors import OutOfRange
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine

N = 3


@pytest.mark.parametrize("shared_us", [None, 3.0, 1e6])
def test_asked_and_allowed_are_summed_over_frames_and_not_over_retries(bundle: Bundle, shared_us: float | None) -> None:
    engine = Engine(Bots(bundle, max_bots=4))
    full_us = CostModel.declared(engine.table).full_us
    handles = engine.bots.start(N, budgets_us=[2.0, 0.0, 1e6])
    allowed_us, asked_us = min(2.0 + full_us, shared_us or np.inf), 0.0
    for frame in range(4):
        options = {} if shared_us is None else {"frame_budget_us": shared_us}
        queries = engine.ask(handles, frame, **options)
        assert engine.ask(handles, frame, **options) is queries
        asked_us += queries.cost_us_N.sum()
        engine.submit(handles, frame, queries)
    spent = engine.bots.spent
    assert spent.asked_us == pytest.approx(asked_us)
    assert spent.allowed_us == pytest.approx(4 * allowed_us)
    assert 0.0 < spent.asked_us <= spent.allowed_us
    assert spent.n_measured == 0


def test_a_frames_own_budget_is_what_it_allowed(bundle: Bundle) -> None:
    engine = Engine(Bots(bundle, max_bots=4))
    handles = engine.bots.start(N, budgets_us=[1e6] * N)
    engine.ask(handles, 0, budgets_us=[1.0, 0.5, 0.0])
    assert engine.bots.spent.allowed_us == pytest.approx(1.5)


def test_measurements_are_counted_against_predictions_and_budgets(bundle: Bundle) -> None:
    engine = Engine(Bots(bundle, max_bots=4))
    declared = CostModel.declared(engine.table)
    handles, costs = engine.bots.start(N, budgets_us=[1e6] * N), Costs(declared)
    over_budget, predicted_us, measured_us = 0, [], []
    for frame in range(6):
        budget_us = float(declared.full_us) * 1.5
        queries = engine.ask(handles, frame, frame_budget_us=budget_us)
        turn = (handles, frame, queries.query_NM, engine.costly(frame, N))
        if not queries.query_NM.any():
            continue
        predicted_us.append(
            float((queries.query_NM * costs.costs_M).sum() + costs.call_us * queries.query_NM.any(1).sum())
        )
        measured_us.append(3.0 * float(declared.query_cost_us(queries.query_NM).sum()))
        over_budget += measured_us[-1] > budget_us
        with pytest.raises(OutOfRange):
            engine.bots.submit_features(*turn, acquire_us=-1.0, costs=costs)
        for _ in range(2):  # the second is a retry
            engine.bots.submit_features(*turn, acquire_us=measured_us[-1], costs=costs)
    spent, error_us = engine.bots.spent, np.array(measured_us) - predicted_us
    assert spent.n_measured == len(measured_us) == costs.n_frames > 2
    assert spent.n_over_predicted == costs.n_over == (error_us > 0).sum() > 0
    assert spent.n_over_budget == over_budget > 0
    assert spent.measured_us == pytest.approx(sum(measured_us))
    assert spent.predicted_us == pytest.approx(sum(predicted_us))
    assert spent.error_us == pytest.approx(np.abs(error_us).sum())
