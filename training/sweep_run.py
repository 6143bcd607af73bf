"""One run of a sweep, in a process of its own: train -> export -> evaluate, and nothing that is there already.

The process gets its run as one line on standard input, and ends when that input ends: no run outlives its sweep.
This module knows nothing about grids, other runs or Ray.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Literal

import msgspec

from training.config import TrainConfig
from training.evaluate import EvaluateConfig, evaluate, write_evaluation
from training.replace_file import replace_file

__all__ = ["Run", "launch", "perform"]

_ELSEWHERE = ("out", "device")  # settings that say where a run is, not what it is
_LOCK_S = 5.0  # longest wait for a process of the same run that is ending
_END_S = 10.0  # for a process to end by itself once it is told to
_POLL_S = 0.2


@dataclass(frozen=True)
class Run:
    """What is trained, and how it is evaluated. Its folder is config.out."""

    config: TrainConfig
    evaluations: dict[str, EvaluateConfig]  # by label, the file's name in evaluations/

    @property
    def name(self) -> str:
        return self.config.name

    @property
    def bundle(self) -> Path:
        return self.config.out / "bundle"

    def fingerprint(self) -> str:
        """SHA-256 of the settings that are not at their default (so that a new setting changes no old run) and of the
        evaluations."""
        settings = {}
        for field in dataclasses.fields(self.config):
            value = getattr(self.config, field.name)
            if field.name not in _ELSEWHERE and value != field.default:
                settings[field.name] = value
        terms = {label: _terms(asked) for label, asked in self.evaluations.items()}
        return hashlib.sha256(msgspec.json.encode([settings, terms], enc_hook=str, order="sorted")).hexdigest()

    def missing(self) -> list[str]:
        """Labels of the evaluations that are not there yet."""
        return [label for label, asked in self.evaluations.items() if not _is_there(asked)]

    def progress(self) -> int:
        """Updates made, as far as the metrics tell."""
        try:
            last = (self.config.out / "metrics.jsonl").read_bytes().rsplit(b"\n", 2)[-2]
            return int(msgspec.json.decode(last)["update"])
        except (OSError, IndexError, KeyError, ValueError, msgspec.DecodeError):
            return 0  # only shown, and never a reason to stop other runs

    def state(self) -> Literal["new", "begun", "done"]:
        """How far the folder is. Raises ValueError where it was made with other settings, or a file of it is broken."""
        out = self.config.out
        if (out / "config.json").exists():
            theirs = TrainConfig.read(out / "config.json")
            for name, value in asdict(self.config).items():
                if name not in _ELSEWHERE and getattr(theirs, name) != value:
                    raise ValueError(_changed(out, name, getattr(theirs, name), value))
        for asked in self.evaluations.values():
            if asked.out is not None and asked.out.exists():
                episodes = _read(asked.out, "episodes")
                if episodes != asked.episodes:
                    raise ValueError(_changed(asked.out, "episodes", episodes, asked.episodes))
        marker = out / "done.json"
        whole = marker.exists() and (self.bundle / "manifest.json").exists() and not self.missing()
        if whole and _read(marker, "settings") == self.fingerprint():
            return "done"
        return "begun" if out.exists() else "new"


def _changed(path: Path, name: str, theirs: object, ours: object) -> str:
    return f"{path} was made with {name} {theirs}, the sweep has {ours}: delete it, or give the sweep another out"


def _read(path: Path, name: str) -> object:
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict)[name]
    except (msgspec.DecodeError, KeyError) as error:
        raise ValueError(f"{path} is broken, delete it and it is made again: {error}") from error


def _terms(asked: EvaluateConfig) -> list[object]:
    mapped = asked.heat_map is not None
    return [asked.episodes, asked.seed, asked.target_cost, asked.budget, asked.frame_budget, asked.bots, mapped]


def _is_there(asked: EvaluateConfig) -> bool:
    return all(path is None or path.exists() for path in (asked.out, asked.heat_map))


def perform(run: Run, workers: int) -> None:
    """Do what is still to do, and mark the run as done. Its bundle is exported only from a training that ended."""
    out = run.config.out
    for scratch in out.glob(".export-*"):
        shutil.rmtree(scratch)  # of an export that was killed
    if not (run.bundle / "manifest.json").exists():
        # The sweep's own process makes no network, and does without torch's seconds and memory.
        from training.export import ExportConfig, export
        from training.train import train

        _say("training")
        train(run.config)
        _say("exporting")
        export(ExportConfig(out, run.bundle))
    (out / "evaluations").mkdir(exist_ok=True)
    for label in run.missing():
        _say(f"evaluating {label}")
        _evaluate(dataclasses.replace(run.evaluations[label], workers=workers))
    replace_file(out / "done.json", msgspec.json.format(msgspec.json.encode({"settings": run.fingerprint()})) + b"\n")
    _say("done")


def _evaluate(asked: EvaluateConfig) -> None:
    """Write the heat map and then the evaluation, each whole or not at all."""
    heat_map = None if asked.heat_map is None else asked.heat_map.with_suffix(".partial")
    evaluation, episodes = evaluate(dataclasses.replace(asked, heat_map=heat_map))
    if heat_map is not None and asked.heat_map is not None:
        os.replace(heat_map, asked.heat_map)
    if asked.out is not None:
        partial = asked.out.with_suffix(".partial")
        write_evaluation(partial, evaluation, episodes)
        os.replace(partial, asked.out)


def _say(what: str) -> None:
    print(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')} {what}", flush=True)


def launch(run: Run, folder: str, threads: int, stopped: threading.Event | None = None) -> str:
    """Perform the run in a fresh process, from `folder`, its output to the run's log.txt; returns why it failed, or
    nothing. Ends the process when `stopped` is set or KeyboardInterrupt comes."""
    out = Path(folder) / run.config.out
    out.mkdir(parents=True, exist_ok=True)
    with (out / "log.txt").open("ab") as log:
        if not _lock(log):
            return f"another process is at work in {run.config.out}"
        process = subprocess.Popen(
            [sys.executable, "-m", "training.sweep_run"],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=log,
            cwd=folder,
            env=os.environ | {"OMP_NUM_THREADS": str(threads)},
            start_new_session=True,  # Ctrl-C comes to the sweep alone, which ends the process and its children
        )
        try:
            _tell(process, run, threads)
            while _status(process) is None:
                if stopped is not None and stopped.is_set():
                    return "stopped"
        finally:
            _end(process)
    if process.returncode < 0:
        return f"killed by {signal.Signals(-process.returncode).name}"
    lines = (out / "log.txt").read_text(errors="replace").strip().splitlines()
    return (lines or ["no output"])[-1] if process.returncode else ""


def _lock(log: IO[bytes]) -> bool:
    """Whether this process and its child now own the log, until both have closed it."""
    deadline = time.monotonic() + _LOCK_S
    while True:
        try:
            fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= deadline:
                return False
            time.sleep(_POLL_S)


def _tell(process: subprocess.Popen[bytes], run: Run, threads: int) -> None:
    if process.stdin is None:
        raise RuntimeError("the process of a run was started without an input")
    with suppress(BrokenPipeError):  # it ended already: its status says why
        process.stdin.write(msgspec.json.encode([run, threads], enc_hook=str) + b"\n")
        process.stdin.flush()  # and stays open for as long as the run is wanted


def _status(process: subprocess.Popen[bytes]) -> int | None:
    try:
        return process.wait(_POLL_S)
    except subprocess.TimeoutExpired:
        return None


def _end(process: subprocess.Popen[bytes]) -> None:
    """Ask it to end if it has not; then kill what is left of it, its evaluation's processes too."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _end_with_sweep() -> None:
    while os.read(0, 1):
        pass
    os.killpg(0, signal.SIGKILL)


def main() -> None:
    """Perform the run that standard input names."""
    line = sys.stdin.buffer.readline()
    run, threads = msgspec.json.decode(line, type=tuple[Run, int], dec_hook=lambda kind, value: kind(value))
    threading.Thread(target=_end_with_sweep, daemon=True).start()
    perform(run, threads)


if __name__ == "__main__":
    main()
