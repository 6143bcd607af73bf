"""The weight γ of the cost constraint, and how it moves from batch to batch.

Two controls. *algorithm-1* is the paper's: the penalty φ of Eq. 2 counts what single frames spend above C, and γ rises
by ε after every batch with φ > 0; it never falls. Queries are Bernoulli samples, so some frame of a batch is always
above C: γ rises for ever and the budget ends up unspent. *dual* is a Lagrangian: the mean cost shall be C, and γ moves
up with the relative excess of that mean over C and down with its relative slack, which settles where the budget is
spent. It moves in asinh(γ), by at most ε a batch: by equal factors where γ is large, and through zero where it is not.
A γ below zero pays for asking. That is what makes a network find out what it could do with a larger budget: its
acquisition head serves small ones too, and an action head that has never seen a feature does not miss it.

Where the budget is an input, C is drawn from strata and each stratum has a γ of its own: what a feature must be worth
to be acquired differs by orders of magnitude between C = 0.5 and C = 0.01. This module knows nothing about networks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from training.objectives import penalty

__all__ = ["Control", "Spent", "draw_costs"]

_FIRST_WEIGHT = 0.05  # of the dual control: features are nearly free at first, so that their worth is seen
_MOST_WEIGHT = 1e3
_LINEAR = 0.02  # below it γ moves in equal steps, above it by equal factors
_LEAST_COST = 1e-3  # the relative excess over C = 0 is taken over this share


def draw_costs(
    edges: tuple[float, ...], groups: int, chance: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """A target cost C and its stratum for each of `groups` groups of windows, each shape [groups].

    Strata follow each other from a random first one, so that a batch has as many of each as possible; within a
    stratum C is log-uniform between its two edges.
    """
    strata = (chance.integers(len(edges) - 1) + np.arange(groups)) % (len(edges) - 1)
    low, high = np.log(np.asarray(edges))[strata], np.log(np.asarray(edges))[strata + 1]
    return np.exp(chance.uniform(low, high)).astype(np.float32), strata


class Spent(NamedTuple):
    """What a batch asked for, and what it was allowed."""

    cost_BT: Tensor
    target_B: Tensor
    stratum_B: Tensor
    valid_BT: Tensor

    def means(self, strata: int) -> dict[str, float]:
        """φ of Eq. 2 and the mean cost asked for; of each of so many strata as a share of its C as well."""
        counted_BT, valid_BT = self.cost_BT * self.valid_BT, self.valid_BT
        phi = penalty(self.cost_BT, self.target_B[:, None], valid_BT)
        means = {"phi": phi.item(), "cost": (counted_BT.sum() / valid_BT.sum()).item()}
        for i in range(strata):
            rows = self.stratum_B == i
            if rows.any():
                allowed = (self.target_B[rows, None] * valid_BT[rows]).sum()
                means[f"spent_{i}"] = (counted_BT[rows].sum() / allowed).item()
        return means


@dataclass
class Control:
    """γ of each stratum; one stratum where C is fixed."""

    kind: str  # algorithm-1 | dual
    step: float  # ε
    floor: float  # least γ of the dual control
    weights: list[float] = field(default_factory=list)

    @classmethod
    def of(cls, kind: str, step: float, strata: int, floor: float = -0.1) -> Control:
        """γ before the first batch: zero as printed, or small."""
        return cls(kind, step, floor, [0.0 if kind == "algorithm-1" else _FIRST_WEIGHT] * strata)

    def penalty(self, cost_BT: Tensor, target_B: Tensor, stratum_B: Tensor, valid_BT: Tensor) -> Tensor:
        """What is added to Δ, a scalar."""
        weight_BT = torch.tensor(self.weights, device=cost_BT.device)[stratum_B][:, None] * valid_BT
        if self.kind == "algorithm-1":
            return penalty(cost_BT, target_B[:, None], valid_BT, weight_BT)
        return (weight_BT * (cost_BT - target_B[:, None])).sum() / valid_BT.sum()

    def means(self) -> dict[str, float]:
        """γ, and that of each stratum where there are several."""
        means = {"gamma": sum(self.weights) / len(self.weights)}
        if len(self.weights) > 1:
            means |= {f"gamma_{i}": weight for i, weight in enumerate(self.weights)}
        return means

    def observe(self, cost_BT: Tensor, target_B: Tensor, stratum_B: Tensor, valid_BT: Tensor) -> None:
        """Move each γ after a batch that spent `cost_BT`."""
        for i in range(len(self.weights)):
            rows = stratum_B == i
            if not rows.any():
                continue
            cost, target, valid = cost_BT[rows], target_B[rows, None], valid_BT[rows]
            if self.kind == "algorithm-1":
                self.weights[i] += self.step if penalty(cost, target, valid).item() > 0.0 else 0.0
                continue
            spent, allowed = (cost * valid).sum().item(), (target * valid).sum().item()
            excess = (spent - allowed) / max(allowed, _LEAST_COST * valid.sum().item())
            moved = math.asinh(self.weights[i] / _LINEAR) + self.step * min(max(excess, -1.0), 1.0)
            self.weights[i] = min(max(_LINEAR * math.sinh(moved), self.floor), _MOST_WEIGHT)
