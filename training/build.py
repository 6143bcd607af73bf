"""From a configuration and traces to a network that is normalised by them.

This module knows nothing about losses, sampling or files.
"""

from __future__ import annotations

import torch

from protocol.features import FeatureTable
from training.config import TrainConfig
from training.iql import Critics
from training.mlp import BudgetedPerceptron
from training.models import BudgetedDecisionTransformer
from training.policy import BudgetedPolicy, ModelConfig, Normalisation
from training.statistics import Spread
from training.trace_source import TraceSource

__all__ = ["build_critics", "build_model", "make_policy"]

_RETURN_DEVIATION = 30.0  # of returns-to-go after scaling, about what IQL's authors' locomotion rewards have


def make_policy(config: ModelConfig) -> BudgetedPolicy:
    """An untrained network of the method that `config` names."""
    return BudgetedDecisionTransformer(config) if config.has_memory else BudgetedPerceptron(config)


def build_model(config: TrainConfig, traces: TraceSource) -> BudgetedPolicy:
    """A network for these traces, normalised by them. Raises ValueError where the action layout is another."""
    layout = traces.layout
    components = layout.action.components
    if config.bins and len(config.bins) != len(components):
        raise ValueError(f"bins has {len(config.bins)} numbers, the action has {len(components)} components")
    if layout.choices is not None and config.bins != (layout.choices,):
        raise ValueError(f"bins is {config.bins}, expected ({layout.choices},): the action is one of so many choices")
    names = [component.name for component in components]
    if unknown := set(config.sampled) - set(names):
        raise ValueError(f"sampled names {sorted(unknown)}, the action has {names}")
    model = make_policy(
        ModelConfig(
            octaves=_octaves(config, layout.features),
            owner=tuple(int(i) for i in layout.features.owner),
            n_queries=layout.features.n_queries,
            bins=config.bins,
            low=tuple(component.low for component in components),
            high=tuple(component.high for component in components),
            sampled=tuple(component.name in config.sampled for component in components),
            method=config.method,
            context_length=config.context_length if config.method == "bdt" else 1,
            width=config.width,
            n_layers=config.n_layers,
            n_heads=config.n_heads,
            n_kv_heads=config.n_kv_heads,
            encoder_width=config.encoder_width,
            acquisition=config.acquisition,
            acquisition_bias=config.acquisition_bias,
            target_cost=config.budget,
            cost_range=(config.budgets[0], config.budgets[-1]) if config.budgets else None,
        )
    )
    statistics = traces.statistics
    _fit(model.normalise_free, statistics.free)
    _fit(model.normalise_costly, statistics.costly)
    _fit(model.normalise_return, statistics.returns_to_go)
    return model


def _fit(normalisation: Normalisation, spread: Spread) -> None:
    normalisation.fit(torch.tensor(spread.mean), torch.tensor(spread.scale))


def _octaves(config: TrainConfig, features: FeatureTable) -> tuple[int, ...]:
    """Of each free number. Raises ValueError for a feature that is not there or not free."""
    free = features.free
    if unknown := set(config.octaves) - {feature.name for feature in free}:
        raise ValueError(f"octaves names {sorted(unknown)}, the free features are {[feature.name for feature in free]}")
    return tuple(config.octaves.get(feature.name, config.fourier) for feature in free for _ in range(feature.size))


def build_critics(model: BudgetedPolicy) -> Critics | None:
    """IQL's critics for this policy; the other methods have none."""
    if model.config.method != "iql":
        return None
    context = model.encode_context.in_features
    scale = float(model.normalise_return.scale) / _RETURN_DEVIATION
    return Critics(context + len(model.config.owner), model.config.n_actions, scale)
