"""Network outputs to allocate, from the likely to the malicious, each with costs and budgets that make sense for it.

This module knows nothing about what `allocate` does with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.noise import uniforms
from bot_runtime.policy import Policy
from protocol.features import CostModel

__all__ = ["Case", "Source", "adversarial", "all_ones", "hostile", "trained", "uniform"]

_HOSTILE_PROBS = np.array([math.nan, math.inf, -math.inf, -1.0, 2.0, 1e308, -0.0, 5e-324])
_HOSTILE_BUDGETS = np.array([math.nan, -math.inf, -1.0, -0.0, 0.0, 5e-324, 1e-300, 1e-9])
_MAGNITUDES = np.array([[-3.0, 3.0], [-12.0, 6.0], [0.0, 0.3], [-320.0, -300.0]])  # powers of ten, from and to


@dataclass(frozen=True)
class Case:
    """One batch for `allocate`: its arguments by name, shapes as there."""

    probs_NM: np.ndarray
    sampled_NM: np.ndarray
    costs_us: np.ndarray
    call_us: float
    budgets_us_N: np.ndarray
    frame_budget_us: float | None


Source = Callable[[np.random.Generator, int], Case]


def trained(bundle: Bundle, golden_probs_TM: np.ndarray) -> Source:
    """A bundle's acquisition head on inputs drawn at random, and its golden episode with shaken log-odds."""
    policy, manifest = Policy(bundle), bundle.manifest
    table, declared = manifest.features, CostModel.declared(manifest.features)

    def source(random: np.random.Generator, n_bots: int) -> Case:
        if random.random() < 0.5:
            probs = np.clip(golden_probs_TM[random.integers(0, len(golden_probs_TM), n_bots)], 1e-6, 1.0 - 1e-6)
            odds = np.log(probs / (1.0 - probs)) + random.normal(0.0, 2.0, probs.shape)
            probs = 1.0 / (1.0 + np.exp(-odds))
        else:
            low, high = (np.clip(limit, -100.0, 100.0) for limit in table.free_range)
            free = random.uniform(low, high, (n_bots, table.n_free))
            returns_to_go = random.uniform(-1.0, 1.0, n_bots) * manifest.target_return
            batch = Contexts(manifest, n_bots).batch(np.arange(n_bots))
            batch.past_NW[:] = random.normal(0.0, 1.5, (n_bots, manifest.width))
            batch.free_NF[:], batch.left_N1[:, 0] = free, returns_to_go
            batch.target_cost_N1[:] = random.random((n_bots, 1))
            policy.query_probs(batch)
            probs = batch.probs_NM
        return _priced(random, probs, declared.costs_us)

    return source


def uniform(random: np.random.Generator, n_bots: int) -> Case:
    """Any probability is as likely as any other; costs as rays of a few ranges have them."""
    costs = random.choice([1.3, 2.2, 4.1, 5.9, 8.2, 14.7], int(random.integers(1, 97)))
    return _priced(random, random.random((n_bots, costs.size)), costs)


def all_ones(random: np.random.Generator, n_bots: int) -> Case:
    """Everything is asked for; no two costs are equal."""
    costs = random.lognormal(1.0, 1.0, int(random.integers(1, 97)))
    return _priced(random, np.ones((n_bots, costs.size)), costs)


def hostile(random: np.random.Generator, n_bots: int) -> Case:
    """NaN, infinities and nonsense among probabilities and budgets, and samples that no sampler would draw of them."""
    case = uniform(random, n_bots)
    broken = random.random(case.probs_NM.shape) < random.choice([0.02, 0.5, 1.0])
    probs = np.where(broken, random.choice(_HOSTILE_PROBS, case.probs_NM.shape), case.probs_NM)
    budgets = np.where(random.random(n_bots) < 0.3, random.choice(_HOSTILE_BUDGETS, n_bots), case.budgets_us_N)
    frame = float(random.choice(_HOSTILE_BUDGETS)) if random.random() < 0.2 else case.frame_budget_us
    sampled = _sampled(random, probs) | (random.random(probs.shape) < 0.3)
    return Case(probs, sampled, case.costs_us, case.call_us, budgets, frame)


def adversarial(random: np.random.Generator, n_bots: int) -> Case:
    """Costs of very different magnitude; budgets on float sums of subsets, an ulp beside them, tiny or not positive.

    Probabilities make greedy take the subset first, so that its own sum meets the budget as closely as it can.
    """
    shape = (n_bots, int(random.integers(1, 65)))
    costs = 10.0 ** random.uniform(*random.choice(_MAGNITUDES), shape[1])
    costs = np.where(random.random(shape[1]) < 0.3, random.choice([0.1, 0.3, 1.0 / 3.0, 1e6, 0.0]), costs)
    call = float(random.choice([0.0, 0.1, 1e-9, 16.0, 1e6]))
    sampled = random.random(shape) < random.uniform(0.1, 1.0)
    subset = sampled & (random.random(shape) < random.uniform(0.1, 1.0))
    order = random.permutation(shape[1])
    sums = np.where(subset, costs, 0.0)[:, order].cumsum(axis=1)[:, -1] + call * subset.any(axis=1)
    ulps = random.integers(-1, 2, n_bots)
    budgets = np.where(ulps == 0, sums, np.nextafter(sums, np.where(ulps > 0, np.inf, -np.inf)))
    budgets = np.where(random.random(n_bots) < 0.1, random.choice(_HOSTILE_BUDGETS, n_bots), budgets)
    probs = costs / max(float(costs.max()), 5e-324) * np.where(subset, 1.0, 0.5)
    frame = None
    if random.random() < 0.6:
        frame = _near_sum(random, budgets)
        if random.random() < 0.5:  # only the shared budget binds
            budgets = np.full(n_bots, np.inf)
    return Case(probs, sampled, costs, call, budgets, frame)


def _near_sum(random: np.random.Generator, budgets_N: np.ndarray) -> float:
    """The float sum of the legal budgets in some order, or a part of it, give or take an ulp."""
    legal_N = np.where(np.isfinite(budgets_N) & (budgets_N > 0.0), budgets_N, 0.0)
    total = float(random.permutation(legal_N).cumsum()[-1]) * float(random.choice([1.0, 1.0, 0.3]))
    return float(np.nextafter(total, random.choice([-np.inf, total, np.inf])))


def _priced(random: np.random.Generator, probs_NM: np.ndarray, costs_M: np.ndarray) -> Case:
    """Budgets from a thousandth of the full cost to all of it; half of the frames share one as well."""
    n_bots, full_us = len(probs_NM), float(costs_M.sum())
    budgets = full_us * random.choice([0.001, 0.01, 0.1, 0.5, 1.0], n_bots) * random.uniform(0.5, 1.0)
    frame = float(budgets.sum() * random.uniform(0.05, 1.2)) if random.random() < 0.5 else None
    return Case(probs_NM, _sampled(random, probs_NM), costs_M, float(random.choice([0.0, 16.0])), budgets, frame)


def _sampled(random: np.random.Generator, probs_NM: np.ndarray) -> np.ndarray:
    seeds_N = random.integers(0, 2**63, len(probs_NM)).astype(np.uint64)
    return uniforms(seeds_N, random.integers(0, 1000, len(probs_NM)), probs_NM.shape[1]) < probs_NM
