"""One iteration of Algorithm 1's loop: state, pass, update.

Every update samples the queries that the paper's sequential loop would sample, takes one pass with gradients, and moves
γ by what the batch spent; the method is what differs in Δ. This module knows nothing about files.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor, nn

from training import workers
from training.acquisition import Rollout, backward, rollout, sample_queries, sample_queries_incrementally
from training.allocation import fit_bots, fit_frames
from training.build import build_critics, build_model
from training.config import TrainConfig
from training.control import Control, Spent
from training.draws import Drawn, draw_share
from training.iql import Critics, taught
from training.objectives import action_loss, query_cost
from training.policy import BudgetedPolicy, Known
from training.trace_source import TraceSource
from training.traces import EXAMPLE_STEPS, Traces

__all__ = ["Pass", "TrainState", "feature_costs", "held_out_loss", "know", "learning_rate", "new_state", "update"]

_CRITIC_RATE = 3e-4


@dataclass
class TrainState:
    """All that changes while training."""

    model: BudgetedPolicy
    optimiser: torch.optim.AdamW
    control: Control  # γ
    forward: nn.Module  # Pass of the model, as the workers share it
    critics: Critics | None = None  # IQL's
    judge: nn.Module | None = None  # its losses, as the workers share them
    critic_optimiser: torch.optim.Adam | None = None
    done: int = 0  # updates made
    seconds: float = 0.0  # spent training, resumed runs included
    lengthened: dict[int, int] = field(default_factory=dict)  # after so many updates: how many the run had till then
    metrics: dict[str, float] = field(default_factory=dict)


def new_state(config: TrainConfig, traces: TraceSource) -> TrainState:
    """A run before its first update. Raises ValueError where settings and traces do not fit."""
    _check_exportable(config, traces)
    torch.manual_seed(config.seed)
    model = build_model(config, traces)
    critics = build_critics(model)
    model.to(config.device)
    optimiser = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    control = Control.of(config.control, config.penalty_step, max(len(config.budgets) - 1, 1), config.penalty_floor)
    forward = workers.spread(Pass(config, model, feature_costs(config, traces)), unused=config.acquisition != "learned")
    state = TrainState(model, optimiser, control, forward)
    if critics is not None:
        state.critics, state.judge = critics, workers.spread(critics.to(config.device))
        state.critic_optimiser = torch.optim.Adam(critics.parameters(), lr=_CRITIC_RATE)
    return state


def _check_exportable(config: TrainConfig, traces: TraceSource) -> None:
    """What would only be noticed when the run is done. A bundle is verified by an episode that outlasts its memory."""
    if not traces.layout.features.n_queries:
        raise ValueError("no feature has a cost, expected one or more: there is nothing to decide on")
    memory, n_steps = config.context_length if config.method == "bdt" else 1, len(traces.example.returns_to_go_T)
    if n_steps <= memory:
        raise ValueError(
            f"the longest episode has {n_steps} timesteps (what lies beyond {EXAMPLE_STEPS} is not counted), expected "
            f"more than {f'context_length {memory}' if memory > 1 else '1'}"
        )


def feature_costs(config: TrainConfig, traces: TraceSource) -> Tensor:
    """f, us: what each query costs, [M]."""
    return torch.tensor(traces.layout.features.costs_us, dtype=torch.float32, device=config.device)


def learning_rate(config: TrainConfig, done: int) -> float:
    """Linear warm-up, then a cosine to zero."""
    warm = min(1.0, (done + 1) / config.warmup)
    return config.learning_rate * warm * 0.5 * (1.0 + math.cos(math.pi * done / config.updates))


class Pass(nn.Module):
    """Queries along a batch, and one pass with them: all that reads the network's parameters."""

    def __init__(self, config: TrainConfig, model: BudgetedPolicy, costs_M: Tensor) -> None:
        super().__init__()
        self.config, self.model, self.costs_M = config, model, costs_M

    def forward(self, drawn: Drawn) -> tuple[Rollout, Tensor, int]:
        """The pass, -log π̃ of the recorded actions [B, T], and how many passes or steps the queries took."""
        known = know(self.model, drawn)
        query_BTM, passes = self._sample(known, drawn)
        sampled = rollout(self.model, known, query_BTM.requires_grad_())
        return sampled, self.model.action_head.losses(sampled.hidden_BTW, drawn.batch.actions_BTA), passes

    def _sample(self, known: Known, drawn: Drawn) -> tuple[Tensor, int]:
        config, fit = self.config, None
        if config.allocation == "bot":
            fit = fit_bots(self.costs_M, drawn.target_B)
        elif config.allocation == "frame":
            fit = fit_frames(self.costs_M, drawn.target_B, config.frame_bots)
        sampler = sample_queries if config.sampler == "parallel" else sample_queries_incrementally
        return sampler(self.model, known, drawn.uniforms_BTM, fit)


def know(model: BudgetedPolicy, drawn: Drawn) -> Known:
    """All that the batch tells before its queries."""
    batch = drawn.batch
    target_BT1 = drawn.target_B[:, None, None].expand_as(batch.returns_to_go_BT1)
    return model.know(batch.free_BTF, batch.returns_to_go_BT1, target_BT1, batch.costly_BTD)


def update(config: TrainConfig, state: TrainState, traces: Traces, costs_M: Tensor) -> None:
    """One iteration of Algorithm 1's loop. Its chance depends on the seed and its number alone, so that a resumed run
    is the run that was stopped."""
    model, control = state.model, state.control
    drawn = draw_share(config, traces, np.random.default_rng([config.seed, state.done]))
    counted_BT, valid_BT, whole = drawn.counted_BT, drawn.batch.valid_BT, drawn.whole
    state.optimiser.zero_grad(set_to_none=True)
    weight_BT = _critics_update(state, drawn)
    sampled, losses_BT, passes = state.forward(drawn)
    losses_BT = losses_BT * (drawn.batch.weight_BT if weight_BT is None else drawn.batch.weight_BT * weight_BT)
    cost_BT = _asked_cost(sampled, drawn, costs_M)
    # γφ depends on the queries alone, so it moves the acquisition path and leaves the action head as it is.
    # While its memory fills a network pays what it pays elsewhere, or it would ask for all then; γ moves by the rest.
    penalised = control.penalty(cost_BT, drawn.target_B, drawn.stratum_B, valid_BT) * valid_BT.sum() / counted_BT.sum()
    loss = workers.weigh(counted_BT, whole.counted_BT) * (action_loss(losses_BT, counted_BT) + penalised)
    backward(sampled, loss, config.sweeps if model.config.has_memory else 1, list(model.parameters()))
    norm = float(torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip))
    if not math.isfinite(norm):  # what follows would replace the last good checkpoint by one without a number in it
        raise ValueError(f"update {state.done + 1} has no finite gradient: try a lower learning_rate")
    for group in state.optimiser.param_groups:
        group["lr"] = learning_rate(config, state.done)
    state.optimiser.step()
    cost_BT, losses_BT = workers.gather(torch.stack([cost_BT, losses_BT], dim=-1).detach()).unbind(-1)
    spent = Spent(cost_BT, whole.target_B, whole.stratum_B, whole.counted_BT)
    if config.acquisition == "learned":
        control.observe(*spent)
    state.done += 1
    delta, n_strata = action_loss(losses_BT, whole.counted_BT).item(), max(len(config.budgets) - 1, 0)
    state.metrics = {"delta": delta, **spent.means(n_strata), "passes": float(passes), "gradient_norm": norm}
    state.metrics |= control.means()


def _asked_cost(sampled: Rollout, drawn: Drawn, costs_M: Tensor) -> Tensor:
    """Cost of what was asked for, [B, T], and not of what allocation left of it: the network must learn to ask for what
    it may have. The gradient is that of the query."""
    asked_BTM = (drawn.uniforms_BTM < sampled.probs_BTM).to(costs_M.dtype)
    return query_cost(sampled.query_BTM + (asked_BTM - sampled.query_BTM).detach(), costs_M)


def _critics_update(state: TrainState, drawn: Drawn) -> Tensor | None:
    """One step of IQL's critics; the weight of each timestep's action, [B, T]."""
    if state.critics is None or state.judge is None or state.critic_optimiser is None:
        return None
    model, critics, batch, whole = state.model, state.critics, drawn.batch, drawn.whole
    with torch.no_grad():
        context = model.context(batch.free_BTF, batch.returns_to_go_BT1)
        everything = torch.cat([context, model.normalise_costly(batch.costly_BTD)], dim=-1)
    state.critic_optimiser.zero_grad(set_to_none=True)
    togo_BT = batch.returns_to_go_BT1[..., 0]
    value_loss, q_loss = state.judge(everything, batch.actions_BTA, togo_BT, batch.last_BT, drawn.counted_BT)
    value_weight = workers.weigh(drawn.counted_BT, whole.counted_BT)
    q_weight = workers.weigh(taught(batch.last_BT, drawn.counted_BT), taught(whole.last_BT, whole.counted_BT))
    (value_weight * value_loss + q_weight * q_loss).backward()
    state.critic_optimiser.step()
    critics.follow()
    return critics.weights(everything, batch.actions_BTA)


@torch.no_grad()
def held_out_loss(forward: Pass, drawn: Drawn) -> float:
    """Δ on episodes that are not trained on."""
    _, losses_BT, _ = forward(drawn)
    return action_loss(losses_BT, drawn.counted_BT).item()
