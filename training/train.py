"""Algorithm 1, from traces to a checkpoint: `python -m training.train --config training/configs/hard.json`.

Reads top to bottom: state, batch, update, loop. Every update samples the queries that the paper's sequential loop would
sample, takes one pass with gradients, and moves γ by what the batch spent; the method is what differs in Δ. The run's
folder holds what is needed to repeat it (config.json, versions.json), to go on with it (checkpoint.pt) and to judge it
(metrics.jsonl, TensorBoard).
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from training.acquisition import Fit, Rollout, backward, rollout, sample_queries, sample_queries_incrementally
from training.allocation import fit_bots, fit_frames
from training.build import build_critics, build_model
from training.checkpoint import Facts, load_checkpoint
from training.config import TrainConfig
from training.control import Control, draw_costs
from training.iql import Critics
from training.objectives import action_loss, query_cost
from training.policy import BudgetedPolicy, Known
from training.record import RunRecord, write_versions
from training.trace_source import TraceSource, open_traces
from training.traces import Batch, Traces, draw_windows

__all__ = ["Drawn", "TrainState", "draw", "know", "main", "new_state", "train", "update"]

_CRITIC_RATE = 3e-4


@dataclass
class TrainState:
    """All that changes while training."""

    model: BudgetedPolicy
    optimiser: torch.optim.AdamW
    control: Control  # γ
    critics: Critics | None = None  # IQL's
    critic_optimiser: torch.optim.Adam | None = None
    done: int = 0  # updates made
    seconds: float = 0.0  # spent training, resumed runs included
    metrics: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Drawn:
    """A batch, and what chance gave it."""

    batch: Batch
    target_B: Tensor  # C of each window
    stratum_B: Tensor  # and which γ it has
    uniforms_BTM: Tensor


def new_state(config: TrainConfig, traces: TraceSource) -> TrainState:
    """A run before its first update. Raises ValueError where settings and traces do not fit."""
    torch.manual_seed(config.seed)
    model = build_model(config, traces)
    critics = build_critics(model)
    model.to(config.device)
    optimiser = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    control = Control.of(config.control, config.penalty_step, max(len(config.budgets) - 1, 1))
    if critics is None:
        return TrainState(model, optimiser, control)
    critics.to(config.device)
    return TrainState(model, optimiser, control, critics, torch.optim.Adam(critics.parameters(), lr=_CRITIC_RATE))


def learning_rate(config: TrainConfig, done: int) -> float:
    """Linear warm-up, then a cosine to zero."""
    warm = min(1.0, (done + 1) / config.warmup)
    return config.learning_rate * warm * 0.5 * (1.0 + math.cos(math.pi * done / config.updates))


def draw(config: TrainConfig, traces: Traces, chance: np.random.Generator) -> Drawn:
    """Windows, their target costs and the noise of their queries."""
    batch = draw_windows(traces, config.batch, config.window, chance)
    shape = (*batch.valid_BT.shape, traces.layout.features.n_queries)
    uniforms = torch.from_numpy(chance.random(shape, dtype=np.float32)).to(config.device)
    # Past an episode's end nothing is asked for, so that padding takes nothing of a budget that windows share.
    uniforms = torch.where(batch.valid_BT[..., None] > 0.0, uniforms, 1.0)
    together = config.frame_bots if config.allocation == "frame" else 1
    targets, strata = np.full(config.batch, config.budget, np.float32), np.zeros(config.batch, np.int64)
    if config.budgets:
        drawn = draw_costs(config.budgets, config.batch // together, chance)
        targets, strata = (part.repeat(together) for part in drawn)
    device = config.device
    return Drawn(batch, torch.from_numpy(targets).to(device), torch.from_numpy(strata).to(device), uniforms)


def know(model: BudgetedPolicy, drawn: Drawn) -> Known:
    """All that the batch tells before its queries."""
    batch = drawn.batch
    target_BT1 = drawn.target_B[:, None, None].expand_as(batch.returns_to_go_BT1)
    return model.know(batch.free_BTF, batch.returns_to_go_BT1, target_BT1, batch.costly_BTD)


def sample(config: TrainConfig, model: BudgetedPolicy, known: Known, drawn: Drawn, costs_M: Tensor) -> tuple:
    """The queries along the batch, [B, T, M], and how many passes or steps they took."""
    fit: Fit | None = None
    if config.allocation == "bot":
        fit = fit_bots(costs_M, drawn.target_B)
    elif config.allocation == "frame":
        fit = fit_frames(costs_M, drawn.target_B, config.frame_bots)
    sampler = sample_queries if config.sampler == "parallel" else sample_queries_incrementally
    return sampler(model, known, drawn.uniforms_BTM, fit)


def update(config: TrainConfig, state: TrainState, traces: Traces, costs_M: Tensor) -> None:
    """One iteration of Algorithm 1's loop. Its chance depends on the seed and its number alone, so that a resumed run
    is the run that was stopped."""
    model, control = state.model, state.control
    drawn = draw(config, traces, np.random.default_rng([config.seed, state.done]))
    batch, valid_BT = drawn.batch, drawn.batch.valid_BT
    state.optimiser.zero_grad(set_to_none=True)
    known = know(model, drawn)
    query_BTM, passes = sample(config, model, known, drawn, costs_M)
    weight_BT = _critics_update(state, batch)
    parts: dict[str, float] = {}
    costs: list[Tensor] = []

    def loss(sampled: Rollout) -> Tensor:
        delta = _delta(model, sampled, batch, weight_BT)
        # What is asked for counts, and not what allocation left of it: the network must learn to ask for what it may
        # have. The gradient is that of the query.
        asked_BTM = (drawn.uniforms_BTM < sampled.probs_BTM).to(costs_M.dtype)
        asked_BTM = sampled.query_BTM + (asked_BTM - sampled.query_BTM).detach()
        cost_BT = query_cost(asked_BTM, costs_M)
        penalised, phi = control.penalty(cost_BT, drawn.target_B, drawn.stratum_B, valid_BT)
        parts.update(delta=delta.item(), phi=phi.item())
        costs.append(cost_BT.detach())
        # γφ depends on the queries alone, so it moves the acquisition path and leaves the action head as it is.
        return delta + penalised

    sampled = rollout(model, known, query_BTM.requires_grad_())
    backward(sampled, loss, config.sweeps if model.config.has_memory else 1, list(model.parameters()))
    norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
    for group in state.optimiser.param_groups:
        group["lr"] = learning_rate(config, state.done)
    state.optimiser.step()
    if config.acquisition == "learned":
        control.observe(costs[0], drawn.target_B, drawn.stratum_B, valid_BT)
    state.done += 1
    spent = _spent(config, costs[0], drawn) | {"passes": float(passes), "gradient_norm": float(norm)}
    state.metrics = parts | spent | _weights(control)


def _critics_update(state: TrainState, batch: Batch) -> Tensor | None:
    """One step of IQL's critics; the weight of each timestep's action, [B, T]."""
    if state.critics is None or state.critic_optimiser is None:
        return None
    model, critics = state.model, state.critics
    with torch.no_grad():
        context = model.context(batch.free_BTF, batch.returns_to_go_BT1)
        everything = torch.cat([context, model.normalise_costly(batch.costly_BTD)], dim=-1)
    togo_BT = batch.returns_to_go_BT1[..., 0]
    state.critic_optimiser.zero_grad(set_to_none=True)
    critics.loss(everything, batch.actions_BTA, togo_BT, batch.last_BT, batch.valid_BT).backward()
    state.critic_optimiser.step()
    critics.follow()
    return critics.weights(everything, batch.actions_BTA)


@torch.no_grad()
def held_out_loss(config: TrainConfig, model: BudgetedPolicy, traces: Traces, costs_M: Tensor) -> float:
    """Δ on episodes that are not trained on; the same windows and the same noise every time."""
    drawn = draw(config, traces, np.random.default_rng(config.seed))
    known = know(model, drawn)
    query_BTM, _ = sample(config, model, known, drawn, costs_M)
    return _delta(model, rollout(model, known, query_BTM), drawn.batch, None).item()


def _delta(model: BudgetedPolicy, sampled: Rollout, batch: Batch, weight_BT: Tensor | None) -> Tensor:
    losses_BT = model.action_head.losses(sampled.hidden_BTW, batch.actions_BTA)
    return action_loss(losses_BT, batch.valid_BT, weight_BT)


def _spent(config: TrainConfig, cost_BT: Tensor, drawn: Drawn) -> dict[str, float]:
    """Mean cost asked for; where C is an input, of each stratum as a share of its C as well."""
    valid_BT = drawn.batch.valid_BT
    means = {"cost": ((cost_BT * valid_BT).sum() / valid_BT.sum()).item()}
    for i in range(len(config.budgets) - 1):
        rows = drawn.stratum_B == i
        if rows.any():
            allowed = (drawn.target_B[rows, None] * valid_BT[rows]).sum()
            means[f"spent_{i}"] = ((cost_BT[rows] * valid_BT[rows]).sum() / allowed).item()
    return means


def _weights(control: Control) -> dict[str, float]:
    means = {"gamma": sum(control.weights) / len(control.weights)}
    if len(control.weights) > 1:
        means |= {f"gamma_{i}": weight for i, weight in enumerate(control.weights)}
    return means


def train(config: TrainConfig) -> TrainState:
    """Train to the end, from the run's checkpoint if there is one; returns the final state."""
    config.out.mkdir(parents=True, exist_ok=True)
    traces = open_traces(config)
    state = new_state(config, traces)
    facts = Facts.of(traces, config.target_return)
    if (config.out / "checkpoint.pt").exists():
        load_checkpoint(config.out / "checkpoint.pt", config, state)
    config.write(config.out / "config.json")
    write_versions(config.out / "versions.json", traces.statistics, 1)
    costs_M = torch.tensor(traces.layout.features.costs_us, dtype=torch.float32, device=config.device)
    training, held_out = traces.to(config.device).split(config.held_out)

    def measure() -> dict[str, float]:
        if not len(held_out):
            return {}
        return {"held_out": held_out_loss(config, state.model, held_out.pool(0), costs_M)}

    with RunRecord(config, state, facts, measure) as run:
        while state.done < config.updates:
            update(config, state, training.pool(state.done), costs_M)
            run.record()
    return state


def main(arguments: list[str] | None = None) -> None:
    """Command line: `--config FILE`, then any setting to override."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path)
    known, arguments = parser.parse_known_args(arguments)
    default = None if known.config is None else TrainConfig.read(known.config)
    config = tyro.cli(TrainConfig, default=default, args=arguments, description=__doc__)
    train(config)


if __name__ == "__main__":
    main()
