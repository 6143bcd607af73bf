"""Does allocation ever overspend, and how long does it take? And do frames of real rays take longer than their budget?

This module knows nothing about servers. First a million frames of trained, random, certain, broken and adversarial
outputs: a frame is one query of one bot there, and what was asked is judged by an oracle that shares no code with
`bot_runtime.budget`; it adds the costs of the query as exact real numbers. Then the time of `allocate` for 500 bots of
64 rays that share a budget, the best of many. Then frames of real rays (`benchmarks.rays`), by measured µs.

    python -m benchmarks.budget --frames 1000000 --json
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.clocks import Clock
from benchmarks.outputs import Case, Source, adversarial, all_ones, hostile, trained, uniform
from benchmarks.rays import RayTally, cast_frames, play
from bot_runtime.budget import allocate
from bot_runtime.bundle import Bundle
from bot_runtime.costs import Report, as_text
from bot_runtime.golden import read_golden

__all__ = ["Budget", "Tally", "allocation_us", "judge", "main", "measure"]

_EXAMPLES = 5  # of violations, printed for each source
_BATCHES = np.array([1, 4, 16, 64, 256])
_BATCH_WEIGHTS = np.array([0.4, 0.2, 0.2, 0.1, 0.1])  # of batches; most frames are in the large ones


@dataclass(frozen=True)
class Budget:
    """Count budget violations. Exits with 1 if there is any; a frame that took longer than predicted is none."""

    frames: int = 1_000_000  # bot queries to allocate, shared equally by the five sources
    bundle: Path = Path("bundles/hard")  # whose costs and acquisition head the trained source uses
    ray_frames: int = 10_000  # of real rays, after those of calibration; 0 leaves them out
    calibration: int = 3000  # frames of rays before any counts
    ray_bots: int = 8  # in each of them
    clock: Clock = "cpu"  # what rays are timed by: cpu is the thread's own time, wall is for a machine of one's own
    repeats: int = 300  # of each allocation that is timed
    seed: int = 0  # of every random number
    json: bool = False  # print one JSON line instead of a table


@dataclass
class Tally:
    """What the oracle saw of one source."""

    frames: int = 0
    shared_frames: int = 0  # of these, how many shared a frame budget
    cut_frames: int = 0  # asked for less than was sampled
    violations: int = 0
    worst_ratio: float = 0.0  # of a cost and its budget
    examples: list[str] = field(default_factory=list)

    def check(self, costs: list[float], budget: float, what: str) -> None:
        """`costs` are all that was asked for; nothing at all fits any budget, even one that is not a number."""
        if not costs or budget == math.inf:
            return
        # fsum rounds the exact sum once, so its sign is the sign of the real number: no rounding hides a violation.
        if not budget >= 0.0 or math.fsum([*costs, -budget]) > 0.0:
            self.violations += 1
            self.examples.append(f"{what}: {math.fsum(costs)!r} of {budget!r}")
        elif budget > 0.0:
            self.worst_ratio = max(self.worst_ratio, math.fsum(costs) / budget)


def judge(case: Case, query_NM: np.ndarray, tally: Tally) -> None:
    """Check each bot's budget, the shared one, and that nothing was asked for that had not been sampled."""
    everything: list[float] = []
    for row, budget in zip(query_NM, case.budgets_us_N.tolist(), strict=True):
        costs = case.costs_us[row].tolist()
        costs += [case.call_us] if costs else []
        tally.check(costs, budget, "a bot")
        everything += costs
    if case.frame_budget_us is not None:
        tally.check(everything, case.frame_budget_us, "a shared frame")
        tally.shared_frames += len(query_NM)
    stray = (query_NM & ~case.sampled_NM).any(axis=1) | (query_NM & ~np.isfinite(case.probs_NM)).any(axis=1)
    tally.violations += int(stray.sum())
    tally.cut_frames += int((query_NM != case.sampled_NM).any(axis=1).sum())
    tally.frames += len(query_NM)


def measure(config: Budget, *, console: Console) -> dict[str, Tally]:
    """Run every source for its share of the frames; progress goes to `console`."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    kinds: dict[str, Source] = {
        "trained": trained(bundle, golden["probs"].astype(np.float64)),
        "random": uniform,
        "all_ones": all_ones,
        "hostile": hostile,
        "adversarial": adversarial,
    }
    tallies: dict[str, Tally] = {}
    with Progress(console=console) as progress:
        task = progress.add_task("allocating", total=config.frames)
        for index, (name, source) in enumerate(kinds.items()):
            random, tally = np.random.default_rng([config.seed, index]), Tally()
            for n_bots in _batches(random, config.frames // len(kinds) + (index < config.frames % len(kinds))):
                case = source(random, n_bots)
                judge(case, allocate(**vars(case)), tally)
                progress.update(task, advance=n_bots)
            tallies[name] = tally
    return tallies


def allocation_us(repeats: int) -> dict[str, float]:
    """The least µs of one `allocate` over 500 bots x 64 rays, by what was sampled and whether calls cost anything."""
    random, best = np.random.default_rng(0), {}
    costs = np.array([2.58, 4.27, 5.14, 5.37, 5.49, 7.9])[np.arange(64) % 6]
    for name, probs in (("some", random.beta(0.3, 1.0, (500, 64))), ("all", np.ones((500, 64)))):
        sampled = random.random(probs.shape) < probs
        for call_us in (0.0, 16.0):
            budget_us = 0.3 * float((sampled @ costs + call_us * sampled.any(axis=1)).sum())
            case = Case(probs, sampled, costs, call_us, np.full(500, np.inf), budget_us)
            times_ns = []
            for _ in range(repeats):
                begun = time.perf_counter_ns()
                allocate(**vars(case))
                times_ns.append(time.perf_counter_ns() - begun)
            best[f"{name}_sampled_call_{call_us:g}"] = min(times_ns) / 1e3
    return best


def _batches(random: np.random.Generator, frames: int) -> Iterator[int]:
    while frames > 0:
        n_bots = min(frames, int(random.choice(_BATCHES, p=_BATCH_WEIGHTS)))
        yield n_bots
        frames -= n_bots


def main(config: Budget) -> int:
    """Print the tables or the JSON line; the exit status."""
    started_s = time.perf_counter()
    tallies = measure(config, console=Console(stderr=True))
    for name, tally in tallies.items():
        for example in tally.examples[:_EXAMPLES]:
            print(f"violation ({name}): {example}", file=sys.stderr)
    allocate_us, rays = allocation_us(config.repeats), None
    if config.ray_frames:
        with cast_frames("hard", config.clock, config.seed) as cast_us:
            rays = play(config.ray_frames, config.calibration, config.ray_bots, config.clock, config.seed, cast_us)
    violations = sum(tally.violations for tally in tallies.values()) + (rays[0].violations if rays else 0)
    if config.json:
        _print_json(tallies, violations, allocate_us, rays, time.perf_counter() - started_s)
    else:
        _print_tables(tallies, allocate_us, rays)
    return 1 if violations else 0


def _print_json(
    tallies: dict[str, Tally],
    violations: int,
    allocate_us: dict[str, float],
    rays: tuple[RayTally, Report] | None,
    wall_s: float,
) -> None:
    sources = {name: {k: v for k, v in vars(tally).items() if k != "examples"} for name, tally in tallies.items()}
    result = {
        "violations": violations,
        "frames": sum(tally.frames for tally in tallies.values()),
        "worst_ratio": max(tally.worst_ratio for tally in tallies.values()),
        "by_source": sources,
        "allocate_us": {name: round(us, 1) for name, us in allocate_us.items()},
        "measured_over_pct": None if rays is None else round(rays[0].over_pct, 3),
        "rays": None if rays is None else vars(rays[0]),
        "load": round(os.getloadavg()[0], 2),
        "wall_s": round(wall_s, 1),
    }
    print(json.dumps(result))


def _print_tables(
    tallies: dict[str, Tally], allocate_us: dict[str, float], rays: tuple[RayTally, Report] | None
) -> None:
    table = Table("output", "frames", "shared", "cut", "violations", "worst cost/budget")
    for name, t in tallies.items():
        counts = (f"{number:,}" for number in (t.frames, t.shared_frames, t.cut_frames, t.violations))
        table.add_row(name, *counts, repr(t.worst_ratio))
    console = Console()
    console.print(table)
    console.print(f"allocate, 500 bots x 64 rays, best µs (load {os.getloadavg()[0]:.1f}): {allocate_us}")
    if rays is not None:
        tally, report = rays
        console.print(as_text(report))
        console.print(
            f"{tally.frames:,} frames of rays by the {tally.clock} clock, {tally.cut_frames:,} cut to their budget, "
            f"{100.0 * tally.used / max(tally.frames, 1):.0f} % of it used: "
            f"{tally.over} ({tally.over_pct:.2f} %) took longer than it, the worst {tally.worst:.1f} times"
        )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Budget, description=__doc__)))
