"""Algorithm 1, from traces to a checkpoint: `python -m training.train --config training/configs/hard.json`.

One run of updates (training/update.py). Its folder holds what is needed to repeat it (config.json, versions.json), to
go on with it (checkpoint.pt) and to judge it (metrics.jsonl, TensorBoard). Under torchrun several workers share each
batch (training/workers.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
import torch
import tyro

from training import workers
from training.checkpoint import Facts, load_checkpoint
from training.command import command
from training.config import TrainConfig
from training.draws import Drawn, draw
from training.keyframes import weigh_keyframes
from training.record import RunRecord, write_versions
from training.trace_source import TraceSource, open_traces
from training.traces import Traces
from training.update import Pass, TrainState, feature_costs, held_out_loss, new_state, update

__all__ = ["main", "train"]


def train(config: TrainConfig) -> TrainState:
    """Train to the end, from the run's checkpoint if there is one; returns the final state."""
    with _matmul_precision(config.matmul_precision):
        return _train(config)


def _train(config: TrainConfig) -> TrainState:
    _check_device(config.device)
    traces = open_traces(config)
    state = new_state(config, traces)
    if (config.out / "checkpoint.pt").exists():
        load_checkpoint(config.out / "checkpoint.pt", config, state, traces.layout)
    _check_together(config, state)
    training, held_out = traces.split(config.held_out)
    if not len(training):
        raise ValueError(f"held_out {config.held_out} of {len(traces)} episodes leaves none to train on")
    if config.keyframes is not None:
        training = _weigh(config.keyframes, training)
    training, held_out = training.to(config.device), _draw_held_out(config, held_out)
    costs_M = feature_costs(config, traces)
    with nullcontext() if workers.rank() else _begin_record(config, state, traces, held_out) as run:
        while state.done < config.updates:
            update(config, state, training.pool(state.done), costs_M)
            if run is not None:
                run.record()
    return state


def _check_device(device: str) -> None:
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:  # a build without CUDA asserts
        reason = str(error).splitlines()[0]
        raise ValueError(f"device is {device}, expected one that this machine and torch have: {reason}") from error


@contextmanager
def _matmul_precision(precision: str) -> Iterator[None]:
    """Below `highest`, torch may round what it multiplies, not what it adds: to TF32, or where `medium` to bfloat16."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _weigh(run: Path, traces: TraceSource) -> Traces:
    if not isinstance(traces, Traces):
        raise ValueError("keyframes weigh traces in memory, and these are streamed from shards")
    return weigh_keyframes(run, traces)


def _check_together(config: TrainConfig, state: TrainState) -> None:
    done = workers.gather(torch.tensor([state.done], device=config.device)).tolist()
    if len(set(done)) > 1:
        raise ValueError(f"workers are at updates {done}, expected one: they must share the folder {config.out}")


def _draw_held_out(config: TrainConfig, held_out: TraceSource) -> Drawn | None:
    """One batch: the same windows and the same noise every time, and no pool beside that of what is trained on."""
    if not len(held_out):
        return None
    return draw(config, held_out.to(config.device).pool(0), np.random.default_rng(config.seed))


def _begin_record(config: TrainConfig, state: TrainState, traces: TraceSource, held_out: Drawn | None) -> RunRecord:
    config.out.mkdir(parents=True, exist_ok=True)
    config.write(config.out / "config.json")
    write_versions(config.out / "versions.json", traces.statistics, workers.count(), state.lengthened)
    forward = Pass(config, state.model, feature_costs(config, traces))

    def measure() -> dict[str, float]:
        return {} if held_out is None else {"held_out": held_out_loss(forward, held_out)}

    return RunRecord(config, state, Facts.of(traces, config.target_return), measure)


def main(arguments: list[str] | None = None) -> None:
    """Command line: `--config FILE`, then any setting to override."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config", type=Path)
    known, arguments = parser.parse_known_args(arguments)
    with command("stopped: the same command goes on from the last checkpoint"):
        default = None if known.config is None else TrainConfig.read(known.config)
        config = tyro.cli(TrainConfig, default=default, args=arguments, description=__doc__)
        with workers.joined(config.device):
            train(config)


if __name__ == "__main__":
    main()
