"""Allocation is hard for any input, and as good as it claims to be."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bot_runtime import budget, greedy
from bot_runtime.budget import allocate
from protocol.features import CostModel

ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)
COSTS = st.one_of(
    st.sampled_from([0.0, 0.1, 0.3, 1.0, 1 / 3, 8.2, 1e-300, 5e-324, 1e6]), st.floats(0.0, 1e6), st.floats(0.0, 1e-6)
)
PROBS = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 1.0]), ANY_FLOAT)


def true_cost(row: np.ndarray, costs: np.ndarray, call: float) -> Fraction:
    """The oracle: exact, in three lines, knowing nothing of numpy's order of adding."""
    asked = [Fraction(float(cost)) for bit, cost in zip(row, costs, strict=True) if bit]
    return sum(asked, Fraction(float(call)) if asked else Fraction(0))


def ulps_around(number: float) -> list[float]:
    return [math.nextafter(number, -math.inf), number, math.nextafter(number, math.inf)]


@st.composite
def cases(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray, float | None]:
    """Probabilities, samples, costs, call, budgets, frame budget; budgets like to sit on a float sum of a subset."""
    n_bots, n_queries = draw(st.integers(1, 4)), draw(st.integers(1, 6))

    def array(strategy: st.SearchStrategy, *shape: int) -> np.ndarray:
        return np.array(draw(st.lists(strategy, min_size=math.prod(shape), max_size=math.prod(shape)))).reshape(shape)

    costs, call = array(COSTS, n_queries), draw(st.one_of(st.just(0.0), COSTS))
    subset = array(st.booleans(), n_queries)
    sums = [float(costs[subset].sum() + call), float(sum(costs[subset][::-1].tolist(), call))]
    edges = st.sampled_from([edge for total in sums for edge in ulps_around(total)])
    budgets = st.one_of(edges, st.floats(0.0, 1e6), st.sampled_from([0.0, -0.0, -1.0, 5e-324, math.inf]), ANY_FLOAT)
    frame = draw(st.one_of(st.none(), budgets))
    return (
        array(PROBS, n_bots, n_queries),
        array(st.booleans(), n_bots, n_queries),
        costs,
        call,
        array(budgets, n_bots),
        frame,
    )


@settings(max_examples=1000)
@given(cases())
def test_never_above_any_budget(case: tuple) -> None:
    probs, sampled, costs, call, budgets, frame = case
    query = allocate(probs, sampled, costs, call, budgets, frame)
    assert query.dtype == np.bool_
    assert not (query & ~sampled).any()
    assert not (query & ~np.isfinite(probs)).any()
    library = CostModel(call, tuple(costs.tolist())).query_cost_us(query)
    for row in np.flatnonzero(query.any(axis=1)):
        assert true_cost(query[row], costs, call) <= budgets[row]
        assert library[row] <= budgets[row]
    if frame is not None and query.any():
        assert sum(true_cost(row, costs, call) for row in query) <= frame
        assert library.sum() <= frame


@settings(max_examples=300)
@given(cases())
def test_deterministic_and_rows_are_independent(case: tuple) -> None:
    probs, sampled, costs, call, budgets, frame = case
    columns_first = map(np.asfortranarray, (probs, sampled, np.broadcast_to(costs, probs.shape)))
    assert np.array_equal(
        allocate(probs, sampled, costs, call, budgets, frame), allocate(*columns_first, call, budgets, frame)
    )
    together = allocate(probs, sampled, costs, call, budgets)
    for row in range(len(probs)):
        one = slice(row, row + 1)
        assert np.array_equal(allocate(probs[one], sampled[one], costs, call, budgets[one]), together[one])


@settings(max_examples=300)
@given(cases())
def test_free_when_nothing_binds(case: tuple) -> None:
    probs, sampled, costs, call, _, _ = case
    probs = np.nan_to_num(probs)
    plenty = (float(costs.sum()) + call) * 1.001 * len(probs)
    assert np.array_equal(allocate(probs, sampled, costs, call, plenty, plenty), sampled)
    assert np.array_equal(allocate(probs, sampled, costs, call, math.inf, math.inf), sampled)


@settings(max_examples=300)
@given(cases())
def test_maximal(case: tuple) -> None:
    """Nothing that was left out would still have fitted, but for the margin that is kept back."""
    probs, sampled, costs, call, budgets, _ = case
    query = allocate(probs, sampled, costs, call, budgets)
    tight = budget._limits(budgets, costs.size + 1) * (1.0 - 1e-12)
    for row, column in np.argwhere(sampled & np.isfinite(probs) & ~query):
        if not query[row].any() or query[row].sum() > 1:  # a single feature worth more than the rest may stand alone
            more = query[row].copy()
            more[column] = True
            assert not float(true_cost(more, costs, call)) <= tight[row]


def test_what_is_worth_least_of_all_is_still_asked_for_where_it_fits() -> None:
    """A network may give anything for a probability; a density of minus infinity is not the lack of one."""
    sampled = np.array([[False, False, True, True]])
    probs = np.array([[0.0, 0.0, 0.5, -1e8]])
    costs = np.array([1.0, 1.0, 0.2, 1e-301])
    assert allocate(probs, sampled, costs, 0.0, 0.1).tolist() == [[False, False, False, True]]


def by_slope(probs: np.ndarray, sampled: np.ndarray, costs: np.ndarray, call: float) -> list[tuple[int, int]]:
    """What all bots ask for: each bot's densest features up to the most that they are worth per µs with the call."""
    slopes: dict[tuple[int, int], float] = {}
    for bot in range(len(probs)):
        features = sorted(np.flatnonzero(sampled[bot]).tolist(), key=lambda at: -probs[bot, at] / costs[at])
        runs = [features[: k + 1] for k in range(len(features))]
        worth = [probs[bot, run].sum() / (call + costs[run].sum()) for run in runs]
        for k, feature in enumerate(features):
            is_opening = k <= int(np.argmax(worth))
            slopes[bot, feature] = max(worth) if is_opening else probs[bot, feature] / costs[feature]
    return sorted(slopes, key=lambda at: -slopes[at])


def sequential_greedy(
    probs: np.ndarray, sampled: np.ndarray, costs: np.ndarray, call: float, limit: float
) -> np.ndarray:
    """All bots share `limit`: the steepest first, one at a time, skipping what does not fit."""
    query, spent = np.zeros_like(sampled), 0.0
    for bot, feature in by_slope(probs, sampled, costs, call):
        price = costs[feature] + (0.0 if query[bot].any() else call)
        if spent + price <= limit:
            query[bot, feature] = True
            spent += price
    return query


@pytest.mark.parametrize("call", [0.0, 3.0])
def test_equals_greedy_one_feature_at_a_time(call: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole-number costs, so that no sum is rounded; budgets half a µs above any sum, so that no margin matters."""
    for name in ("_single_if_better", "_alone_if_better"):
        monkeypatch.setattr(greedy, name, lambda chosen, *_: chosen)
    random = np.random.default_rng(7)
    for _ in range(300):
        n_bots, n_queries = random.integers(1, 6), random.integers(1, 9)
        probs, costs = random.random((n_bots, n_queries)), random.integers(1, 12, n_queries).astype(float)
        sampled = random.random((n_bots, n_queries)) < 0.7
        limit = float(random.integers(0, 60)) + 0.5
        shared = allocate(probs, sampled, costs, call, math.inf, limit)
        assert np.array_equal(shared, sequential_greedy(probs, sampled, costs, call, limit))
        own = allocate(probs, sampled, costs, call, limit)
        for row in range(n_bots):
            one = slice(row, row + 1)
            assert np.array_equal(own[one], sequential_greedy(probs[one], sampled[one], costs, call, limit))


@pytest.mark.parametrize("call", [0.0, 3.0])
def test_worth_at_least_half_of_the_optimum(call: float) -> None:
    """Against every subset; on average far better than half, and equal to the optimum most of the time."""
    random, ratios = np.random.default_rng(3), []
    for _ in range(200):
        costs, probs = random.integers(1, 30, 8).astype(float), random.random((1, 8))
        limit = float(random.integers(4, 100)) + 0.5
        query = allocate(probs, np.ones((1, 8), dtype=np.bool_), costs, call, limit)
        subsets = np.array(list(itertools.product([False, True], repeat=8)))
        fits = subsets @ costs + call * subsets.any(axis=1) <= limit
        best = (subsets[fits] @ probs[0]).max()
        ratios.append(1.0 if best == 0.0 else probs[0][query[0]].sum() / best)
    assert min(ratios) >= 0.5
    assert np.mean(ratios) > 0.95


def test_one_dear_and_certain_feature_beats_a_cheap_doubtful_one() -> None:
    query = allocate([[0.2, 0.99]], np.array([[True, True]]), [1.0, 10.0], 0.0, 10.5)
    assert query.tolist() == [[False, True]]


def test_the_call_is_paid_once_by_each_bot_that_asks() -> None:
    probs, sampled = np.full((3, 2), 0.5), np.array([[True, True], [True, True], [False, False]])
    assert allocate(probs, sampled, [1.0, 1.0], 10.0, 12.5, 24.5).tolist() == sampled.tolist()
    assert allocate(probs, sampled, [1.0, 1.0], 10.0, 12.5, 23.5).sum() == 3
    assert allocate(probs, sampled, [1.0, 1.0], 10.0, 12.5, 12.5).tolist() == [
        [True, True],
        [False, False],
        [False, False],
    ]
    assert allocate(probs, sampled, [1.0, 1.0], 10.0, 10.5).sum() == 0


def test_costs_and_calls_may_differ_by_bot() -> None:
    probs, sampled = np.full((2, 1), 0.5), np.ones((2, 1), dtype=np.bool_)
    assert allocate(probs, sampled, [[1.0], [9.0]], [0.0, 0.0], 5.0).tolist() == [[True], [False]]
    assert allocate(probs, sampled, [1.0], [9.0, 0.0], 5.0).tolist() == [[False], [True]]


@pytest.mark.parametrize("hostile", [math.nan, math.inf, -math.inf, -1.0])
def test_hostile_costs_ask_for_nothing(hostile: float) -> None:
    ones = np.ones((1, 2), dtype=np.bool_)
    assert allocate(ones, ones, [hostile, 1.0], 0.0, 100.0).tolist() == [[False, True]]
    assert not allocate(ones, ones, [1.0, 1.0], hostile, 100.0).any()


def test_many_different_costs_end_after_a_bounded_number_of_passes() -> None:
    """A table made to be slow: each pass takes one tiny feature and blocks on one that just no longer fits."""
    n_pairs = 200
    dear = 1000.0 - 0.5 * np.arange(n_pairs)
    costs = np.stack([np.full(n_pairs, 0.6), dear], axis=1).ravel()
    probs = np.linspace(1.0, 0.9, costs.size) * costs / 1000.0
    query = allocate(probs[None], np.ones((1, costs.size), dtype=np.bool_), costs, 0.0, 1000.0)
    assert query.any()
    assert true_cost(query[0], costs, 0.0) <= 1000.0


def test_no_costly_features_and_no_bots() -> None:
    assert allocate(np.zeros((2, 0)), np.zeros((2, 0), dtype=np.bool_), [], 1.0, 5.0, 5.0).shape == (2, 0)
    assert allocate(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.bool_), [1.0, 2.0, 3.0], 1.0, [], 5.0).shape == (0, 3)
