"""What greedy gives up: never more than its docstring says, against every subset and against dynamic programming."""

from __future__ import annotations

import itertools
import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bot_runtime.budget import allocate

Problem = tuple[np.ndarray, np.ndarray, np.ndarray, float]  # values [N, I], costs [N, I], calls [N], limit
ROUNDING = 1e-7  # slopes that differ by less count as equal


@st.composite
def problems(draw: st.DrawFn, with_calls: bool) -> Problem:
    """Up to 10 features of up to 4 bots; whole costs and a limit between two sums, so that no rounding matters."""
    n_bots = draw(st.integers(1, 4))
    n_features = draw(st.integers(1, 10 // n_bots))

    def table(numbers: st.SearchStrategy, *shape: int) -> np.ndarray:
        size = math.prod(shape)
        return np.array(draw(st.lists(numbers, min_size=size, max_size=size)), dtype=float).reshape(shape)

    costs = table(st.integers(0, 12), n_bots, n_features)
    calls = table(st.integers(0, 30), n_bots) if with_calls else np.zeros(n_bots)
    low = int((costs.sum(axis=1) + calls).max()) if with_calls else 0
    values = table(st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 0.5, 1.0])), n_bots, n_features)
    return values, costs, calls, draw(st.integers(low, low + 60)) + 0.5


def optimum(values: np.ndarray, costs: np.ndarray, calls: np.ndarray, limit: float) -> float:
    """The oracle: every subset."""
    subsets = np.array(list(itertools.product([False, True], repeat=values.size))).reshape(-1, *values.shape)
    spent = (subsets * costs).sum(axis=(1, 2)) + subsets.any(axis=2) @ calls
    return float((subsets * values).sum(axis=(1, 2))[spent <= limit].max())


def worth(values: np.ndarray, costs: np.ndarray, calls: np.ndarray, limit: float) -> float:
    query = allocate(values, np.ones(values.shape, dtype=np.bool_), costs, calls, math.inf, limit)
    assert costs[query].sum() + calls[query.any(axis=1)].sum() <= limit
    return float(values[query].sum())


@settings(max_examples=300, deadline=None)
@given(problems(with_calls=False))
def test_without_calls_at_most_one_feature_short_of_the_optimum(problem: Problem) -> None:
    best, got = optimum(*problem), worth(*problem)
    assert got >= best - problem[0].max() - ROUNDING
    assert got >= best / 2.0 - ROUNDING


@settings(max_examples=300, deadline=None)
@given(problems(with_calls=True))
def test_with_calls_at_most_one_opening_or_feature_short_of_the_optimum(problem: Problem) -> None:
    values, costs, calls, _ = problem
    best, got = optimum(*problem), worth(*problem)
    assert got >= best - max(opening(*row) for row in zip(values, costs, calls, strict=True)) - ROUNDING
    assert got >= best / 2.0 - ROUNDING


def opening(values: np.ndarray, costs: np.ndarray, call: float) -> float:
    """The worth of a bot's opening, or of its best later feature: all prefixes in the order of density, one by one."""
    order = sorted(range(values.size), key=lambda at: -values[at] / max(costs[at], 1e-300))
    slopes = [values[order[: k + 1]].sum() / max(call + costs[order[: k + 1]].sum(), 1e-300) for k in range(len(order))]
    last = max(k for k, slope in enumerate(slopes) if slope >= max(slopes) * (1.0 - ROUNDING))
    return float(max(values[order[: last + 1]].sum(), values.max()))


def test_calls_are_weighed_with_what_they_open() -> None:
    """By density alone the first bot's one feature would be called for, and leave too little for ninety others."""
    probs, sampled = np.full((2, 100), 0.9), np.ones((2, 100), dtype=np.bool_)
    probs[0, 0], sampled[0, 1:] = 1.0, False
    query = allocate(probs, sampled, np.ones(100), 100.0, math.inf, 200.5)
    assert query.sum(axis=1).tolist() == [0, 100]


def grouped_optimum(values: np.ndarray, costs: np.ndarray, calls: np.ndarray, limit: int) -> float:
    """Dynamic programming: the most that each bot is worth by whole µs, then bots one after the other."""
    total = np.zeros(limit + 1)
    for row_values, row_costs, call in zip(values, costs.astype(int), calls.astype(int), strict=True):
        alone = np.zeros(limit + 1)
        for value, cost in zip(row_values, row_costs, strict=True):
            alone[cost:] = np.maximum(alone[cost:], alone[: limit + 1 - cost] + value)
        called = np.concatenate([np.zeros(call), alone])[: limit + 1]
        total = np.array([(total[: us + 1] + called[us::-1]).max() for us in range(limit + 1)])
    return float(total[-1])


def test_close_to_the_optimum_where_bots_are_many() -> None:
    """Measured, not proven: 8 bots of 16 rays, with the costs of rays and of calls that an engine has."""
    random, ratios = np.random.default_rng(1), []
    for call in (0.0, 16.0):
        for limit in (40, 120, 240):
            values, costs = random.beta(0.3, 1.0, (8, 16)), random.choice([1.0, 2.0, 3.0, 5.0], (8, 16))
            calls = np.full(8, call)
            ratios.append(worth(values, costs, calls, limit + 0.5) / grouped_optimum(values, costs, calls, limit))
    assert min(ratios) > 0.9
    assert np.mean(ratios) > 0.97
