"""Costs that are measured: what they learn, what cannot fool them, and how many frames may cost more than predicted."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.costs import MAX_ACQUIRE_US, Costs, Row, as_text, main
from protocol.errors import FrameReused, NonFinite, OutOfRange
from protocol.features import CostModel
from tests.bot_runtime.conftest import Engine

DECLARED = CostModel(10.0, (1.0,) * 8 + (3.0,) * 8 + (7.0,) * 8)
TRUTH = CostModel(24.0, (2.5,) * 8 + (3.0,) * 8 + (4.0,) * 8)
STEP, WITHIN = 0.05, 32.0


def queries(random: np.random.Generator, frames: int) -> list[np.ndarray]:
    """Of 6 bots that want now a little of everything, now much of something."""
    return [random.random((6, 24)) < random.random((6, 1)) * np.repeat(random.random(3), 8) for _ in range(frames)]


def play(costs: Costs, asked: list[np.ndarray], measure: Callable[[np.ndarray], float]) -> np.ndarray:
    """Whether each frame cost more than was predicted before it."""
    over = []
    for query in asked:
        us = measure(query)
        over.append(us > costs.model.query_cost_us(query).sum())
        costs.observe(query, us)
    return np.array(over)


def true_us(query: np.ndarray) -> float:
    return float(TRUTH.query_cost_us(query).sum())


def test_until_something_is_measured_costs_are_exactly_what_was_declared() -> None:
    costs = Costs(DECLARED)
    assert costs.model == DECLARED
    assert costs.full_us == DECLARED.full_us


def test_a_wrong_declaration_is_left_behind() -> None:
    costs = Costs(DECLARED)
    play(costs, queries(np.random.default_rng(0), 400), true_us)
    estimated = {row.group: row.estimated_us for row in costs.report().rows}
    assert estimated == pytest.approx({"call": 24.0, "1 µs": 2.5, "3 µs": 3.0, "7 µs": 4.0}, rel=0.02)


def test_a_call_that_is_declared_free_is_found() -> None:
    costs = Costs(CostModel(0.0, DECLARED.feature_us))
    play(costs, queries(np.random.default_rng(0), 1500), true_us)
    assert costs.report().rows[0].estimated_us == pytest.approx(24.0, rel=0.05)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_the_stated_quantile_of_frames_stays_within_the_prediction(noise: float) -> None:
    random = np.random.default_rng(1)
    costs = Costs(DECLARED, quantile=0.99)
    over = play(costs, queries(random, 6000), lambda query: true_us(query) * math.exp(random.normal(0.0, noise)))
    assert over[1000:].mean() < 0.0125
    call = costs.report().rows[0]
    assert call.charged_us / call.estimated_us == pytest.approx(math.exp(2.33 * noise), rel=0.25)


def test_costs_that_change_are_followed() -> None:
    random = np.random.default_rng(2)
    costs = Costs(DECLARED)
    asked = queries(random, 2000)
    play(costs, asked[:1000], true_us)
    over = play(costs, asked[1000:], lambda query: 3.0 * true_us(query))
    assert not over[100:].any()
    assert costs.full_us < 3.0 * 3.0 * TRUTH.full_us


def test_a_stalled_frame_moves_little() -> None:
    random = np.random.default_rng(3)
    costs = Costs(DECLARED)
    play(costs, queries(random, 1000), lambda query: true_us(query) * math.exp(random.normal(0.0, 0.05)))
    before = costs.full_us
    costs.observe(queries(random, 1)[0], 50_000.0)
    assert before < costs.full_us < 1.1 * before


def test_stalls_of_many_frames_are_within_the_bound() -> None:
    """One frame in a thousand takes 50 ms: that is half of what the quantile allows, and costs no more for it."""
    random = np.random.default_rng(4)
    costs = Costs(DECLARED)
    over = play(costs, queries(random, 3000), lambda query: 50_000.0 if random.random() < 0.001 else true_us(query))
    assert over.sum() == costs.n_over < 0.002 * 3000 + 40
    assert costs.full_us < 1.6 * TRUTH.full_us


ANY_US = st.one_of(
    st.sampled_from([0.0, -0.0, -1.0, 5e-324, 1e300, MAX_ACQUIRE_US, math.nan, math.inf, -math.inf]), st.floats()
)
ANY_COST = st.one_of(st.sampled_from([0.0, 5e-324, 1e-300, 1e-9, 1.0, 1e6]), st.floats(0.0, 1e6))


@given(
    st.tuples(ANY_COST, st.lists(ANY_COST, max_size=20)),
    st.lists(st.tuples(ANY_US, st.integers(0, 2**32 - 1)), max_size=30),
)
def test_whatever_is_reported_costs_stay_within_their_bounds(
    declared: tuple[float, list[float]], reported: list[tuple[float, int]]
) -> None:
    call_us, feature_us = declared
    costs = Costs(CostModel(call_us, tuple(feature_us)))
    for us, seed in reported:
        before, n_frames = costs.model, costs.n_frames
        costs.observe(np.random.default_rng(seed).random((2, len(feature_us))) < 0.5, us)
        if not 0.0 <= us <= MAX_ACQUIRE_US:
            assert (costs.model, costs.n_frames) == (before, n_frames)
    rounding = 1.0 + 1e-9
    assert np.all(costs.costs_M <= np.minimum(np.array(feature_us) * WITHIN, 1e6) * rounding)
    assert np.all(costs.costs_M * WITHIN * rounding >= np.array(feature_us) * (1.0 - 1e-9) - 1e-300)
    largest_call_us = call_us or (sum(feature_us) / max(len(feature_us), 1))
    assert call_us / WITHIN / rounding - 1e-300 <= costs.call_us <= min(largest_call_us * WITHIN, 1e6) * rounding
    CostModel(costs.call_us, tuple(costs.costs_M.tolist()))
    msgspec.json.encode(costs.report())


@given(st.lists(st.floats(0.05, 20.0), min_size=1, max_size=200), st.integers(0, 100))
def test_any_sequence_within_the_bounds_is_over_no_more_often_than_is_proven(ratios: list[float], seed: int) -> None:
    """Adversarial: each measurement is a chosen multiple of what was declared."""
    costs, asked = Costs(DECLARED, quantile=0.9), queries(np.random.default_rng(seed), len(ratios))
    pairs = iter(ratios)
    over = play(costs, asked, lambda query: next(pairs) * float(DECLARED.query_cost_us(query).sum()))
    assert over.sum() <= 0.1 * len(ratios) + math.log(WITHIN) / STEP + 1.0


def test_nothing_acquired_says_nothing() -> None:
    costs = Costs(DECLARED)
    costs.observe(np.zeros((3, 24), dtype=np.bool_), 500.0)
    assert (costs.n_frames, costs.model) == (0, DECLARED)


def test_a_frame_takes_no_more_memory_than_the_first(engine: Engine) -> None:
    costs, asked = Costs(DECLARED), queries(np.random.default_rng(0), 3)
    sizes = []
    for query in asked:
        costs.observe(query, true_us(query))
        sizes.append(
            sorted((name, getattr(value, "size", len(str(type(value))))) for name, value in vars(costs).items())
        )
    assert sizes[0] == sizes[1] == sizes[2]


def test_the_same_measurements_give_the_same_costs() -> None:
    models = []
    for _ in range(2):
        costs = Costs(DECLARED)
        play(costs, queries(np.random.default_rng(5), 50), true_us)
        models.append(costs.model)
    assert models[0] == models[1]


def test_many_different_costs_share_groups() -> None:
    costs = Costs(CostModel(1.0, tuple(1.0 + i for i in range(100))))
    rows = costs.report().rows
    assert len(rows) == 13
    assert rows[1].group == "1 to 9 µs"
    assert rows[1].declared_us == 5.0


@pytest.mark.parametrize(("quantile", "within"), [(0.0, 2.0), (1.0, 2.0), (math.nan, 2.0), (0.9, 1.0), (0.9, math.nan)])
def test_settings_that_make_no_sense_are_refused(quantile: float, within: float) -> None:
    with pytest.raises(ValueError, match="expected"):
        Costs(DECLARED, quantile=quantile, within=within)


def test_the_report_counts_what_was_acquired_and_what_went_over() -> None:
    costs, query = Costs(DECLARED), np.zeros((2, 24), dtype=np.bool_)
    query[0, [0, 1, 9]] = True
    costs.observe(query, 1000.0)
    report = costs.report()
    assert (report.frames, report.over) == (1, 1)
    assert [row.n for row in report.rows] == [1, 2, 1, 0]
    assert report.rows[0] == Row("call", 10.0, report.rows[0].estimated_us, costs.call_us, 1)
    assert "1 frames measured, 1 (100.00 %) above" in as_text(report)


def test_the_command_line_reads_what_the_server_answers(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for body, printed in ((msgspec.json.encode([Costs(DECLARED).report()]), "declared µs"), (b"[]", "no engine")):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(body)))
        main()
        assert printed in capsys.readouterr().out
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"{}")))
    with pytest.raises(SystemExit, match="/v1/costs"):
        main()


@pytest.fixture
def bots(bundle: Bundle) -> Bots:
    return Bots(bundle, max_bots=4)


def test_budgets_are_kept_by_what_was_measured(bots: Bots) -> None:
    """Every declaration is ten times too low, and each feature has a group of its own.

    What was acquired in hardly any frame but the first has one measurement, which counted as twice what was expected
    then, and stays priced by it until it is acquired again. So a frame may surprise by it, and by nothing else.
    """
    engine, costs = Engine(bots), Costs(CostModel.declared(bots.bundle.manifest.features))
    handles = bots.start(3, seeds=[1, 2, 3], budgets_us=[1e6] * 3)
    shared_us, truth = 20.0, CostModel(0.0, tuple(10.0 * us for us in costs.declared.feature_us))
    spent_us, known = [], []
    for frame in range(300):
        queries = engine.ask(handles, frame, costs=costs, frame_budget_us=shared_us)
        assert queries.cost_us_N.sum() <= shared_us
        measured_us = float(truth.query_cost_us(queries.query_NM).sum())
        spent_us.append(measured_us)
        n_acquired_M = np.array([row.n for row in sorted(costs.report().rows[1:], key=lambda row: row.declared_us)])
        by_cost_M = n_acquired_M[np.argsort(np.argsort(costs.declared.costs_us))]
        known.append(bool((by_cost_M[queries.query_NM.any(axis=0)] > 3).all()))
        bots.submit_features(
            handles, frame, queries.query_NM, engine.costly(frame, 3), acquire_us=measured_us, costs=costs
        )
    assert max(spent_us[:5]) > shared_us
    later = list(zip(spent_us, known, strict=True))[100:]
    assert max(us for us, known in later if known) <= shared_us
    assert sum(not known for _, known in later) <= 5
    assert sum(spent_us[100:]) > 0.0


def test_a_turn_is_measured_once_and_a_retry_repeats_its_measurement(bots: Bots) -> None:
    engine, costs = Engine(bots), Costs(CostModel.declared(bots.bundle.manifest.features))
    handles = bots.start(2, seeds=[1, 2])
    asked = engine.ask(handles, 0, costs=costs)
    assert asked.query_NM.any()
    costly = engine.costly(0, 2)

    def submit(acquire_us: float | None) -> object:
        return bots.submit_features(handles, 0, asked.query_NM, costly, acquire_us=acquire_us, costs=costs)

    for refused, error in ((math.nan, NonFinite), (-1.0, OutOfRange), (1e10, OutOfRange)):
        with pytest.raises(error, match="acquire_us"):
            submit(refused)
    first = submit(30.0)
    model = costs.model
    assert submit(30.0) is first
    for other in (31.0, None):
        with pytest.raises(FrameReused):
            submit(other)
    assert (costs.n_frames, costs.model) == (1, model)


def test_a_cost_at_the_largest_there_is_does_not_round_past_it() -> None:
    costs = Costs(CostModel(0.0, (660263.0,)))
    costs.observe(np.ones((2, 1), dtype=bool), 1e9)
    assert costs.model.feature_us == (1e6,)
