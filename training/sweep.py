"""Many runs: `python -m training.sweep training/sweeps/navigation.json`, each one train -> export -> evaluations.

Methods x maps x datasets x budgets x seeds, as the file says (training/sweep_spec.py), into one folder a run. Runs go
to local processes, or to a Ray cluster whose machines share the folders and this Python. Called again, it goes on: what
is done is not done again. This module knows nothing about networks or environments.
"""

from __future__ import annotations

import fnmatch
import importlib.metadata
import os
import platform
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgspec
import tyro
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from training.command import command
from training.sweep_run import Run, launch
from training.sweep_spec import SweepSpec

__all__ = ["Outcome", "SweepConfig", "main", "sweep"]

_PACKAGES = ("torch", "onnx", "onnxruntime", "numpy", "minari", "gymnasium", "mujoco", "pybullet")
_POLL_S = 1.0
_STOP_S = 30.0  # for Ray's tasks to end the processes that they started
_FILE_COLUMNS = 160  # of what is not written to a terminal: one line a run, to be searched
_STORE_BYTES = 100 * 2**20  # of a Ray started here: tasks send nothing but their names

Submit = Callable[[Run], "Future[str]"]  # the future is why the run failed, or nothing


@dataclass(frozen=True)
class SweepConfig:
    """Which sweep, and where its runs go."""

    spec: tyro.conf.Positional[Path]  # JSON file, see training/sweep_spec.py
    workers: int = os.cpu_count() or 1  # runs at once; a Ray cluster that is there already decides itself
    threads: int | None = None  # of each run (None: cores // workers)
    ray: str | None = None  # address of a Ray cluster, auto for the one of this machine, local to start one
    gpus_per_run: float = 0.0  # share of a GPU that a run gets of Ray: 0.1 puts ten runs on each
    only: str = "*"  # pattern of the names of the runs to do, as a shell's
    dry_run: bool = False  # list the runs and how far they are, and do nothing

    def __post_init__(self) -> None:
        if self.workers < 1 or (self.threads is not None and self.threads < 1):
            raise ValueError(f"workers is {self.workers} and threads {self.threads}, expected 1 or more of each")
        if self.gpus_per_run < 0.0 or (self.gpus_per_run > 0.0 and self.ray is None):
            raise ValueError(f"gpus_per_run is {self.gpus_per_run}, expected 0, or more than 0 with --ray")

    @property
    def threads_per_run(self) -> int:
        return self.threads or max(1, (os.cpu_count() or 1) // self.workers)


@dataclass(frozen=True)
class Outcome:
    """What became of a run."""

    run: Run
    state: str  # done now, done before, failed; new or begun in a dry run
    reason: str = ""  # why it failed


def sweep(config: SweepConfig, console: Console | None = None) -> list[Outcome]:
    """Do every run that is not done, and say what became of each, in the spec's order.

    Raises ValueError for a spec that cannot be, for a folder made with other settings, and where Ray cannot be had.
    """
    console = console or Console()
    spec = SweepSpec.read(config.spec)
    try:
        runs = spec.runs()
    except ValueError as error:
        raise ValueError(f"{config.spec}: {error}") from error
    chosen = [run for run in runs if fnmatch.fnmatchcase(run.name, config.only)]
    if not chosen:
        raise ValueError(f"no run matches {config.only!r}, there are {', '.join(run.name for run in runs)}")
    outcomes = {run.name: Outcome(run, _state(run)) for run in chosen}
    todo = [run for run in chosen if outcomes[run.name].state != "done before"]
    if todo and not config.dry_run:
        _write_about(config, Path(spec.out), [run.name for run in runs])
        with _executor(config) as submit, _Watch(console, len(chosen), len(chosen) - len(todo)) as watch:
            for outcome in _finish({submit(run): run for run in todo}, watch):
                outcomes[outcome.run.name] = outcome
    return list(outcomes.values())


def _state(run: Run) -> str:
    state = run.state()
    return "done before" if state == "done" else state


def _finish(pending: dict[Future[str], Run], watch: _Watch) -> Iterator[Outcome]:
    while pending:
        finished, _ = wait(pending, timeout=_POLL_S, return_when=FIRST_COMPLETED)
        for future in finished:
            run = pending.pop(future)
            error = future.exception()
            reason = future.result() if error is None else (str(error).strip().splitlines() or [repr(error)])[-1]
            outcome = Outcome(run, "failed" if reason else "done", reason)
            watch.finished(outcome)
            yield outcome
        watch.look(list(pending.values()))


def _executor(config: SweepConfig) -> AbstractContextManager[Submit]:
    threads = config.threads_per_run
    if config.ray is None:
        return _processes(config.workers, threads)
    return _ray(config.ray, config.workers, threads, config.gpus_per_run)


@contextmanager
def _processes(workers: int, threads: int) -> Iterator[Submit]:
    """Processes of this machine. Leaving ends those that still run."""
    stopped = threading.Event()
    pool = ThreadPoolExecutor(workers)
    folder = str(Path.cwd())
    try:
        yield lambda run: pool.submit(launch, run, folder, threads, stopped)
    finally:
        stopped.set()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _ray(address: str, workers: int, threads: int, gpus_per_run: float) -> Iterator[Submit]:
    """Tasks of a Ray cluster, each of which starts the run's process where Ray has room for it. Leaving ends those
    that still run, and Ray too if it was started here."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray reports its use unless it is told otherwise
    try:
        import ray
    except ImportError as error:
        raise ValueError("--ray needs Ray, which is not installed: pip install 'ray>=2.40'") from error
    sizes = {"num_cpus": workers * threads, "object_store_memory": _STORE_BYTES} if address == "local" else {}
    try:
        ray.init(address, include_dashboard=False, log_to_driver=False, logging_level="warning", **sizes)
    except ConnectionError as error:
        raise ValueError(f"no Ray cluster at {address}: {error}") from error
    references = []
    try:
        have = ray.cluster_resources()
        for name, amount in (("CPU", threads), ("GPU", gpus_per_run)):
            if have.get(name, 0.0) < amount:  # Ray would wait for ever
                raise ValueError(f"a run asks Ray for {amount:g} {name}, the cluster has {have.get(name, 0.0):g}")
        task = ray.remote(launch).options(num_cpus=threads, num_gpus=gpus_per_run)
        folder = str(Path.cwd())

        def submit(run: Run) -> Future[str]:
            references.append(task.remote(run, folder, threads))
            return references[-1].future()

        yield submit
    finally:
        for reference in references:
            ray.cancel(reference)
        if references:
            ray.wait(references, num_returns=len(references), timeout=_STOP_S)
        ray.shutdown()


class _Watch:
    """A line for each run at work, and one for all. What a run does is read from its folder."""

    def __init__(self, console: Console, total: int, done: int) -> None:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, TextColumn("{task.fields[now]}"), console=console)
        self._all = self._progress.add_task("runs", total=total, completed=done, now="")
        self._lines: dict[str, TaskID] = {}
        self._began = time.time()

    def __enter__(self) -> _Watch:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def look(self, runs: list[Run]) -> None:
        """Show those of these runs that have written to their log since the sweep began."""
        for run in runs:
            log = run.config.out / "log.txt"
            if not log.exists() or log.stat().st_mtime < self._began:
                continue
            if run.name not in self._lines:
                self._lines[run.name] = self._progress.add_task(run.name, total=run.config.updates, now="")
            n, left = len(run.evaluations), len(run.missing())
            now = f"evaluated {n - left} of {n}" if (run.bundle / "manifest.json").exists() else "training"
            self._progress.update(self._lines[run.name], completed=run.progress(), now=now)

    def finished(self, outcome: Outcome) -> None:
        """Take the run's line away, and say what became of it."""
        if outcome.run.name in self._lines:
            self._progress.remove_task(self._lines.pop(outcome.run.name))
        line = f"{outcome.run.name}: {outcome.state} {escape(outcome.reason)}"
        self._progress.console.print(line, soft_wrap=True)
        self._progress.advance(self._all)


def _write_about(config: SweepConfig, out: Path, names: list[str]) -> None:
    """sweep.json: the spec as it was read, its runs, and the versions that do them."""
    packages = (*_PACKAGES, "ray") if config.ray is not None else _PACKAGES
    installed = {distribution.metadata["Name"].lower() for distribution in importlib.metadata.distributions()}
    versions = {name: importlib.metadata.version(name) for name in packages if name in installed}
    versions |= {"python": platform.python_version(), "machine": platform.machine()}
    about = {"spec": msgspec.json.decode(config.spec.read_bytes()), "runs": names, "versions": versions}
    out.mkdir(parents=True, exist_ok=True)
    (out / "sweep.json").write_bytes(msgspec.json.format(msgspec.json.encode(about), indent=1) + b"\n")


def _table(outcomes: list[Outcome]) -> Table:
    table = Table(box=None)
    table.add_column("run", overflow="fold")
    for name in ("state", "updates"):
        table.add_column(name, no_wrap=True)
    table.add_column("still to evaluate", overflow="fold")
    for outcome in outcomes:
        run = outcome.run
        updates = f"{run.progress()}/{run.config.updates}"
        table.add_row(run.name, outcome.state, updates, " ".join(run.missing()))
    return table


def main(arguments: list[str] | None = None) -> None:
    """Command line: a table of the runs; exit status 1 if one failed."""
    console = Console(width=None if sys.stdout.isatty() else _FILE_COLUMNS)
    with command("stopped: the same command goes on from here"):
        outcomes = sweep(tyro.cli(SweepConfig, args=arguments, description=__doc__), console)
    console.print(_table(outcomes))
    failed = [outcome.run for outcome in outcomes if outcome.state == "failed"]
    for run in failed:
        console.print(escape(f"{run.name} failed: see {run.config.out / 'log.txt'}"), soft_wrap=True)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
