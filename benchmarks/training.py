"""Updates a second of the three ways to sample a window's queries, all else equal: `python -m benchmarks.training`.

*sequential* is the paper's loop, the whole history recomputed and differentiated at every timestep; *parallel* iterates
to the same queries in a few passes; *incremental* walks to them over a cache. The same weights, windows and noise in
each, and the queries are compared. The three are timed in turn, so that a busy machine slows them alike. `--profile`
prints where an update's time goes. Made-up traces of the navigation game's sizes: no dataset is needed.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity, profile

from game.env import ACTION_SPEC, feature_table
from training.acquisition import (
    Rollout,
    backward,
    rollout,
    sample_queries,
    sample_queries_incrementally,
    sample_queries_sequentially,
)
from training.config import TrainConfig
from training.control import Control
from training.draws import Drawn, draw
from training.objectives import action_loss, query_cost
from training.policy import Known
from training.steps import Layout
from training.traces import Traces
from training.update import TrainState, know, new_state

__all__ = ["Training", "main", "measure"]


@dataclass(frozen=True)
class Training:
    """Time an update: queries, forward, backward. Batch and optimiser's step are the same for all and left out."""

    batch: int = 40  # windows
    window: int = 60  # timesteps
    repeats: int = 5  # timed updates of each way
    threads: int = 1
    device: str = "cpu"  # as torch names it
    seed: int = 0
    profile: bool = False  # print the profile of the incremental way as well
    json: bool = False  # print one JSON line instead of a table


def _traces(steps: int, seed: int) -> Traces:
    chance, table = torch.Generator().manual_seed(seed), feature_table()
    low = torch.tensor([component.low for component in ACTION_SPEC.components])
    high = torch.tensor([component.high for component in ACTION_SPEC.components])
    return Traces(
        Layout(table, ACTION_SPEC),
        torch.randn(steps, table.n_free, generator=chance),
        torch.randn(steps, table.n_costly, generator=chance).half(),
        low + (high - low) * torch.rand(steps, len(low), generator=chance),
        torch.rand(steps, generator=chance),
        np.arange(0, steps, 200),
        np.full(steps // 200, 200),
    )


def _ways(config: TrainConfig, state: TrainState, costs_M: torch.Tensor) -> dict[str, Callable[[Drawn], torch.Tensor]]:
    """One update by each way; each answers its queries."""
    model = state.model

    def loss(sampled: Rollout, drawn: Drawn) -> torch.Tensor:
        batch = drawn.batch
        penalised = Control.of("algorithm-1", 1.0, 1).penalty(
            query_cost(sampled.query_BTM, costs_M), drawn.target_B, drawn.stratum_B, drawn.counted_BT
        )
        delta = action_loss(model.action_head.losses(sampled.hidden_BTW, batch.actions_BTA), drawn.counted_BT)
        return delta + penalised

    def sequential(drawn: Drawn) -> torch.Tensor:
        sampled = sample_queries_sequentially(model, know(model, drawn), drawn.uniforms_BTM)
        loss(sampled, drawn).backward()
        return sampled.query_BTM.detach().round()

    def swept(sampler: Callable[[object, Known, torch.Tensor], tuple]) -> Callable[[Drawn], torch.Tensor]:
        def run(drawn: Drawn) -> torch.Tensor:
            known = know(model, drawn)
            query, _ = sampler(model, known, drawn.uniforms_BTM)
            sampled = rollout(model, known, query.requires_grad_())
            backward(sampled, loss(sampled, drawn), config.sweeps, list(model.parameters()))
            return query.detach()

        return run

    swept_ways = {"parallel": swept(sample_queries), "incremental": swept(sample_queries_incrementally)}
    return {"sequential": sequential, **swept_ways}


def measure(asked: Training) -> dict[str, float]:
    """Updates a second of each way, ratios to the sequential one, and how many queries differed from its."""
    torch.set_num_threads(asked.threads)
    # The optimiser is never stepped: an acquisition head that has learned nothing yet would ask the same of everyone.
    config = TrainConfig(
        Path(), Path(), "benchmark", bins=(11, 6, 2), batch=asked.batch, window=asked.window, device=asked.device
    )
    traces = _traces(20_000, asked.seed)
    state = new_state(config, traces)
    traces = traces.to(asked.device)
    torch.nn.init.normal_(state.model.acquisition_head.out.weight, std=0.5)
    costs_M = torch.tensor(traces.layout.features.costs_us, dtype=torch.float32, device=asked.device)
    ways, seconds, differing = _ways(config, state, costs_M), {}, 0
    for repeat in range(asked.repeats + 1):  # the first one warms up
        drawn = draw(config, traces, np.random.default_rng([asked.seed, repeat]))
        queries = {}
        for name, way in ways.items():
            state.model.zero_grad()
            began = time.perf_counter()
            queries[name] = way(drawn)
            if asked.device != "cpu":
                torch.cuda.synchronize()
            if repeat:
                seconds.setdefault(name, []).append(time.perf_counter() - began)
        differing += sum(int((query != queries["sequential"]).sum()) for query in queries.values())
    if asked.profile:
        _print_profile(lambda: ways["incremental"](drawn))
    rates = {f"{name}_per_s": 1.0 / statistics.median(times) for name, times in seconds.items()}
    ratios = {
        f"ratio_{name}": statistics.median(np.divide(seconds["sequential"], seconds[name]))
        for name in ("parallel", "incremental")
    }
    return rates | ratios | {"differing_queries": differing, "queries": asked.repeats * drawn.uniforms_BTM.numel()}


def _print_profile(run: Callable[[], object]) -> None:
    devices = [ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if torch.cuda.is_available() else [])]
    with profile(activities=devices) as profiler:
        run()
    print(profiler.key_averages().table(sort_by="self_cpu_time_total", row_limit=15, max_name_column_width=40))


def main() -> None:
    """Command line."""
    asked = tyro.cli(Training, description=__doc__)
    measured = measure(asked)
    if asked.json:
        print(json.dumps(measured))
        return
    table = Table(title=f"updates a second, {asked.batch} windows of {asked.window}, {asked.device}")
    for column in ("way", "updates/s", "times the sequential loop"):
        table.add_column(column, justify="right")
    for name in ("sequential", "parallel", "incremental"):
        table.add_row(name, f"{measured[f'{name}_per_s']:.2f}", f"{measured.get(f'ratio_{name}', 1.0):.1f}")
    Console().print(table)
    Console().print(
        f"{measured['differing_queries']} of {measured['queries']} queries differ from the sequential loop's"
    )


if __name__ == "__main__":
    main()
