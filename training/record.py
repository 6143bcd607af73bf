"""The outside of a run: progress, metrics and checkpoints. An interrupted run goes on from its last checkpoint."""

from __future__ import annotations

import fcntl
import importlib.metadata
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import torch
from rich.progress import Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch.utils.tensorboard import SummaryWriter

from training.checkpoint import Facts, save_checkpoint
from training.config import TrainConfig
from training.metrics import parse_metrics
from training.replace_file import replace_file
from training.statistics import Statistics
from training.update import TrainState

__all__ = ["RunRecord", "write_versions"]


class RunRecord:
    """Writes metrics.jsonl, TensorBoard and checkpoint.pt of one run; call `record` after every update."""

    def __init__(
        self, config: TrainConfig, state: TrainState, facts: Facts, held_out: Callable[[], dict[str, float]]
    ) -> None:
        """`held_out` measures what is only measured once a line."""
        self._config, self._state, self._facts, self._held_out = config, state, facts, held_out
        self._checkpoint = config.out / "checkpoint.pt"
        self._sums: dict[str, float] = {}
        self._counts: dict[str, int] = {}  # updates in each sum: a stratum is not in every batch
        self._began = time.monotonic() - state.seconds
        metrics = config.out / "metrics.jsonl"
        self._lines = metrics.open("a+")
        try:
            fcntl.flock(self._lines, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._keep(metrics)
        except BlockingIOError as error:
            self._lines.close()
            raise ValueError(f"{config.out} is being trained by another process") from error
        except ValueError:
            self._lines.close()
            raise
        self._board = SummaryWriter(str(config.out), purge_step=state.done + 1)
        columns = (*Progress.get_default_columns()[:2], TimeElapsedColumn(), TimeRemainingColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[now]}"))
        self._task = self._progress.add_task(config.name, total=config.updates, completed=state.done, now="")

    def _keep(self, metrics: Path) -> None:
        """Drop what will come again, and a line that a kill or a full disk cut."""
        self._lines.seek(0)
        whole = [line for line in self._lines if line.endswith("\n")]
        told = zip(whole, parse_metrics(metrics, whole), strict=True)
        kept = [text for text, line in told if line["update"] <= self._state.done]
        self._lines.truncate(0)
        self._lines.write("".join(kept))

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
            self._counts[key] = self._counts.get(key, 0) + 1
        self._progress.update(self._task, completed=state.done)
        if state.done % config.log_every == 0:
            self._log({key: value / self._counts[key] for key, value in self._sums.items()} | self._held_out())
            self._sums.clear()
            self._counts.clear()
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


def write_versions(path: Path, statistics: Statistics, workers: int, lengthened: dict[int, int]) -> None:
    """What made a run: versions of the libraries, threads, how much was read, and what config.json does not tell: at
    which updates it was given another number of them, which changes the course of the learning rate."""
    libraries = ("torch", "onnx", "onnxruntime", "numpy", "minari", "pyarrow")
    versions = {name: importlib.metadata.version(name) for name in libraries}
    versions |= {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "threads": str(torch.get_num_threads()),
        "workers": str(workers),
        "episodes": str(statistics.n_episodes),
        "steps": str(statistics.n_steps),
    }
    if lengthened:
        versions["lengthened"] = ", ".join(f"after update {done} of {before}" for done, before in lengthened.items())
    replace_file(path, (json.dumps(versions, indent=2) + "\n").encode())
