"""Algorithm 1, from traces to a checkpoint: `python -m training.train --config training/configs/hard.json`.

Reads top to bottom: configuration, traces, network, loop. Every update samples the queries that the paper's sequential
loop would sample, takes one pass with gradients, and raises γ if the batch violated the budget. The run's folder holds
what is needed to repeat it (config.json, versions.json), to go on with it (checkpoint.pt) and to judge it
(metrics.jsonl, TensorBoard).
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import platform
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import torch
import tyro
from rich.progress import Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from training.acquisition import Rollout, backward, rollout, sample_queries, sample_queries_incrementally
from training.checkpoint import Facts, load_checkpoint, save_checkpoint
from training.config import TrainConfig
from training.models import BudgetedDecisionTransformer, ModelConfig
from training.objectives import action_loss, nearest_bins, penalty, penalty_weight, query_cost
from training.traces import Batch, Traces, draw_windows, load_traces, moments

__all__ = ["TrainState", "build_model", "main", "train", "update"]


@dataclass
class TrainState:
    """All that changes while training."""

    model: BudgetedDecisionTransformer
    optimiser: torch.optim.AdamW
    done: int = 0  # updates made
    penalty_weight: float = 0.0  # γ
    seconds: float = 0.0  # spent training, resumed runs included
    metrics: dict[str, float] = field(default_factory=dict)


def build_model(config: TrainConfig, traces: Traces) -> BudgetedDecisionTransformer:
    """A network for these traces, normalised by them. Raises ValueError where the action layout is another."""
    components = traces.action.components
    if len(config.bins) != len(components):
        raise ValueError(f"bins has {len(config.bins)} numbers, the action has {len(components)} components")
    names = [component.name for component in components]
    if unknown := set(config.sampled) - set(names):
        raise ValueError(f"sampled names {sorted(unknown)}, the action has {names}")
    model = BudgetedDecisionTransformer(
        ModelConfig(
            n_free=traces.features.n_free,
            owner=tuple(int(i) for i in traces.features.owner),
            n_queries=traces.features.n_queries,
            bins=config.bins,
            low=tuple(component.low for component in components),
            high=tuple(component.high for component in components),
            sampled=tuple(component.name in config.sampled for component in components),
            context_length=config.context_length,
            width=config.width,
            n_layers=config.n_layers,
            n_heads=config.n_heads,
            encoder_width=config.encoder_width,
            fourier=config.fourier,
            acquisition=config.acquisition,
            acquisition_bias=config.acquisition_bias,
        )
    )
    model.normalise_free.fit(*moments(traces.free_SF))
    model.normalise_costly.fit(*moments(traces.costly_SD))
    model.normalise_return.fit(*moments(traces.returns_to_go_S[:, None]))
    return model


def learning_rate(config: TrainConfig, done: int) -> float:
    """Linear warm-up, then a cosine to zero."""
    warm = min(1.0, (done + 1) / config.warmup)
    return config.learning_rate * warm * 0.5 * (1.0 + math.cos(math.pi * done / config.updates))


def draw(
    config: TrainConfig, model: BudgetedDecisionTransformer, traces: Traces, chance: np.random.Generator
) -> tuple[Batch, torch.Tensor, float]:
    """A batch, the queries that the network samples along it, [B, T, M], and how many passes or steps those took."""
    batch = draw_windows(traces, config.batch, config.window, chance)
    shape = (*batch.valid_BT.shape, model.config.n_queries)
    uniforms_BTM = torch.from_numpy(chance.random(shape, dtype=np.float32))
    with torch.no_grad():
        context = model.context(batch.free_BTF, batch.returns_to_go_BT1)
    sample = sample_queries if config.sampler == "parallel" else sample_queries_incrementally
    return batch, *sample(model, context, batch.costly_BTD, uniforms_BTM)


def update(config: TrainConfig, state: TrainState, traces: Traces, costs_M: torch.Tensor) -> None:
    """One iteration of Algorithm 1's loop. Its chance depends on the seed and its number alone, so that a resumed run
    is the run that was stopped."""
    model = state.model
    batch, query_BTM, passes = draw(config, model, traces, np.random.default_rng([config.seed, state.done]))
    parts: dict[str, float] = {}

    def loss(sampled: Rollout) -> torch.Tensor:
        delta = _delta(model, sampled, batch)
        cost_BT = query_cost(sampled.query_BTM, costs_M)
        phi = penalty(cost_BT, config.budget, batch.valid_BT)
        parts.update(delta=delta.item(), phi=phi.item())
        parts["cost"] = ((cost_BT * batch.valid_BT).sum() / batch.valid_BT.sum()).item()
        # γφ depends on the queries alone, so it moves the acquisition path and leaves the action head as it is.
        return delta + state.penalty_weight * phi

    state.optimiser.zero_grad(set_to_none=True)
    context = model.context(batch.free_BTF, batch.returns_to_go_BT1)
    backward(rollout(model, context, batch.costly_BTD, query_BTM.requires_grad_()), loss, config.sweeps)
    norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
    for group in state.optimiser.param_groups:
        group["lr"] = learning_rate(config, state.done)
    state.optimiser.step()
    if config.acquisition == "learned":
        state.penalty_weight = penalty_weight(state.penalty_weight, parts["phi"], config.penalty_step)
    state.done += 1
    state.metrics = {**parts, "gamma": state.penalty_weight, "passes": float(passes), "gradient_norm": float(norm)}


@torch.no_grad()
def held_out_loss(config: TrainConfig, model: BudgetedDecisionTransformer, traces: Traces) -> float:
    """Δ on episodes that are not trained on; the same windows and the same noise every time."""
    batch, query_BTM, _ = draw(config, model, traces, np.random.default_rng(config.seed))
    context = model.context(batch.free_BTF, batch.returns_to_go_BT1)
    return _delta(model, rollout(model, context, batch.costly_BTD, query_BTM), batch).item()


def _delta(model: BudgetedDecisionTransformer, sampled: Rollout, batch: Batch) -> torch.Tensor:
    bins_BTA = nearest_bins(batch.actions_BTA, model.config.low, model.config.high, model.config.bins)
    return action_loss(model.action_logits(sampled.hidden_BTW), bins_BTA, batch.valid_BT)


def train(config: TrainConfig) -> TrainState:
    """Train to the end, from the run's checkpoint if there is one; returns the final state."""
    config.out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    traces = load_traces(config.dataset, episodes=config.episodes)
    model = build_model(config, traces)
    optimiser = torch.optim.AdamW(model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    state = TrainState(model, optimiser)
    facts = Facts.of(traces, config.target_return)
    checkpoint = config.out / "checkpoint.pt"
    if checkpoint.exists():
        load_checkpoint(checkpoint, config, state)
    config.write(config.out / "config.json")
    _write_versions(config.out / "versions.json", traces)
    costs_M = torch.tensor(traces.features.costs_us, dtype=torch.float32)
    training, held_out = traces.split(config.held_out)
    with _Run(config, state, checkpoint, facts, held_out) as run:
        while state.done < config.updates:
            update(config, state, training, costs_M)
            run.record()
    return state


class _Run:
    """The outside of a run: progress, metrics and checkpoints. An interrupted run goes on from its last checkpoint."""

    def __init__(
        self, config: TrainConfig, state: TrainState, checkpoint: Path, facts: Facts, held_out: Traces
    ) -> None:
        self._config, self._state, self._held_out = config, state, held_out
        self._checkpoint, self._facts = checkpoint, facts
        self._sums: dict[str, float] = {}
        self._summed = 0  # updates in the sums: fewer than log_every in the first line after a resume
        self._began = time.monotonic() - state.seconds
        metrics = config.out / "metrics.jsonl"
        if metrics.exists():  # lines that came after the checkpoint will come again
            kept = [line for line in metrics.read_text().splitlines(True) if json.loads(line)["update"] <= state.done]
            metrics.write_text("".join(kept))
        self._lines = metrics.open("a")
        self._board = SummaryWriter(str(config.out), purge_step=state.done + 1)
        columns = (*Progress.get_default_columns()[:2], TimeElapsedColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[now]}"))
        self._task = self._progress.add_task(config.name, total=config.updates, completed=state.done, now="")

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        self._board.close()
        self._lines.close()

    def record(self) -> None:
        """Count the update that was just made."""
        state, config = self._state, self._config
        state.seconds = time.monotonic() - self._began
        for key, value in state.metrics.items():
            self._sums[key] = self._sums.get(key, 0.0) + value
        self._summed += 1
        self._progress.update(self._task, completed=state.done)
        if state.done % config.log_every == 0:
            means = {key: value / self._summed for key, value in self._sums.items()}
            if len(self._held_out.lengths_E):
                means["held_out"] = held_out_loss(config, state.model, self._held_out)
            self._log(means)
            self._sums.clear()
            self._summed = 0
        if state.done % config.checkpoint_every == 0 or state.done == config.updates:
            save_checkpoint(self._checkpoint, config, self._facts, state)

    def _log(self, means: dict[str, float]) -> None:
        line = {"update": self._state.done, "seconds": round(self._state.seconds, 1), **means}
        self._lines.write(json.dumps(line) + "\n")
        self._lines.flush()
        for key, value in means.items():
            self._board.add_scalar(key, value, self._state.done)
        now = " ".join(f"{key} {means[key]:.3g}" for key in ("delta", "held_out", "cost", "gamma") if key in means)
        self._progress.update(self._task, now=now)


def _write_versions(path: Path, traces: Traces) -> None:
    versions = {name: importlib.metadata.version(name) for name in ("torch", "onnx", "onnxruntime", "numpy", "minari")}
    versions |= {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": str(torch.get_num_threads()),
    }
    versions |= {"episodes": str(len(traces.lengths_E)), "steps": str(int(traces.lengths_E.sum()))}
    path.write_text(json.dumps(versions, indent=2) + "\n")


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
