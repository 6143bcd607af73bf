"""What does a server do with a quarter to twice of what it can carry, when every request has a deadline?

    python -m benchmarks.overload [--json]

Capacity is measured first, by engines that begin a frame as soon as the last one is done. Then frames come by the
clock (`benchmarks.offered`), and after the worst load half of capacity again: *recovery* is how long it takes from the
change until, for half a second, as much was learned in time as has to be at half the load. Capacity is measured once
more at the end: where it differs, the machine was not the same, and the loads were not what they are called.

By the engine's clock an answer is a *miss* that comes later than its deadline; `flagged` is the share of misses that
say so themselves, by a reason, NOT_READY or `late`. The engine's clock counts the way there and back too, which nobody
at the server can flag, so misses by less than `way_us` are not counted. (`protocol.client` flags those as well, by the
same clock as here: that would be all of them.) `good_hz` counts frames whose action was learned and in time.

Exits with another code than 0 unless, at half the load and less, under 1 % fall back or are refused, at the worst one
99 % of what was accepted is in time, half of the refusals come within an eighth of the deadline (who is refused when it
is read) and 99 % before it (who was accepted to wait, until the machine stood still), and recovery takes 2 s at most.
Where a real-time priority is given and the system limits that to a share of a processor, as Linux does, the server
stands still for the rest of every second in which it has more to do, and at twice the load figures are far worse than
without such a priority: see adr/0020.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from benchmarks.cores import set_apart
from benchmarks.offered import Answered, Engine, Phase, capacity_hz, offer
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.launcher import ServerProcess

__all__ = ["Overload", "main", "measure", "recovery_s", "shortcomings", "summary"]

_WARM_UP_S = 1.0
_WINDOW_S, _STEP_S = 0.5, 0.05  # in which recovery is looked for
_SPARED = 0.01  # of the requests may fall back or be refused at half the load, or be late at any


@dataclass(frozen=True)
class Overload:
    """Offer a server more than it can carry."""

    bundle: Path = Path("bundles/hard")
    bots: int = 16  # of each engine, named together
    engines: int = 32
    deadline_us: float = 8000.0  # of each request: two make a frame of 16 ms
    way_us: float = 1000.0  # what the way there and back may take
    loads: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)  # shares of capacity; it recovers from the last one
    seconds: float = 4.0  # of each load
    server: str = ""  # more settings of the server, as on its command line
    pin: bool = True  # give the server a core of its own, where there are two
    json: bool = False  # print one JSON line instead of a table


def summary(phase: Phase, deadline_us: float, way_us: float) -> dict[str, float]:
    """Shares of requests, percentiles of their times in ms, and why requests fell back."""
    limit_ms = (deadline_us + way_us) / 1e3
    ms = {kind: [each.ms for each in phase.answers if each.kind == kind] for kind in ("learned", "fallback", "refused")}
    missed = [each for each in phase.answers if each.ms > limit_ms]
    flagged = [each for each in missed if each.late or each.kind != "learned"]
    accepted = ms["learned"] + ms["fallback"]
    n_requests = max(1, len(phase.answers))
    rows = {"frames": float(phase.frames), "unsent_pct": 100.0 * phase.unsent / max(1, phase.frames)}
    rows["sent_late_p99_ms"] = float(np.percentile(phase.sent_late_ms or [0.0], 99.0))
    rows["good_hz"] = _good_hz(phase, limit_ms)
    rows |= {f"{kind}_pct": 100.0 * len(of_kind) / n_requests for kind, of_kind in ms.items()}
    causes = Counter(each.cause for each in phase.answers if each.cause)
    rows |= {f"{cause}_pct": 100.0 * n / n_requests for cause, n in sorted(causes.items())}
    rows["in_time_pct"] = 100.0 * sum(each <= limit_ms for each in accepted) / max(1, len(accepted))
    rows |= {"missed": float(len(missed)), "flagged_pct": 100.0 * len(flagged) / len(missed) if missed else 100.0}
    for name, of_kind in (("accepted", accepted), ("refused", ms["refused"])):
        for percentile in (50.0, 99.0, 99.9):
            value = float(np.percentile(of_kind, percentile)) if of_kind else float("nan")
            rows[f"{name}_p{percentile:g}_ms"] = round(value, 3)
    return rows


def _good_hz(phase: Phase, limit_ms: float) -> float:
    if not phase.answers:
        return 0.0
    good = sum(each.is_whole and _is_good(each, limit_ms) for each in phase.answers)
    return good / (phase.answers[-1].at_s - phase.begun_s)


def _is_good(answered: Answered, limit_ms: float) -> bool:
    return answered.kind == "learned" and answered.ms <= limit_ms


def recovery_s(phase: Phase, deadline_us: float, way_us: float) -> float:
    """From the beginning of a bearable load until, for half a second, all but 1 % was learned and in time.

    Not until the last answer that was not: a machine that others use too stalls now and then at any load. As long as
    the phase is, where it did not recover within it.
    """
    limit_ms = (deadline_us + way_us) / 1e3
    at_s = np.array([each.at_s - phase.begun_s for each in phase.answers])
    good = np.array([_is_good(each, limit_ms) for each in phase.answers])
    whole_s = float(at_s[-1]) if len(at_s) else 0.0
    for from_s in np.arange(0.0, whole_s - _WINDOW_S, _STEP_S).tolist():
        within = (at_s >= from_s) & (at_s < from_s + _WINDOW_S)
        if within.any() and good[within].mean() >= 1.0 - _SPARED:
            return float(from_s)
    return whole_s


def shortcomings(measured: dict[str, Any], deadline_us: float) -> list[str]:
    """What is not as it should be, in words."""
    found = []
    for load, rows in measured["loads"].items():
        if float(load) <= 0.5 and rows["learned_pct"] < 100.0 * (1.0 - _SPARED):
            found.append(f"at {load} x {100.0 - rows['learned_pct']:.2f} % were not learned, expected less than 1 %")
    load, rows = list(measured["loads"].items())[-1]
    if rows["in_time_pct"] < 100.0 * (1.0 - _SPARED):
        found.append(f"at {load} x {rows['in_time_pct']:.2f} % of what was accepted was in time, expected 99 %")
    for percentile, most_ms in ((50, deadline_us / 8e3), (99, deadline_us / 1e3)):
        took_ms = rows[f"refused_p{percentile}_ms"]
        if took_ms > most_ms:
            found.append(f"at {load} x refusals took {took_ms:.1f} ms (p{percentile}), expected {most_ms:g}")
    if measured["recovery_s"] > 2.0:
        found.append(f"recovery took {measured['recovery_s']:.2f} s, expected 2")
    return found


def measure(config: Overload) -> dict[str, Any]:
    """Capacity in frames a second, before and after, a summary by load, and how long recovery took."""
    bundle = Bundle.load(config.bundle)
    golden = read_golden((config.bundle / "golden.npz").read_bytes(), bundle.manifest)
    with ExitStack() as stack:
        most = ("--max-bots", str(config.bots * config.engines), "--max-connections", str(config.engines))
        server = stack.enter_context(ServerProcess(config.bundle, *most, *config.server.split()))
        if config.pin:
            stack.callback(set_apart([server.pid]))
        url = server.addresses()["unix"]
        engines = [Engine(url, bundle, golden, config.bots, config.deadline_us) for _ in range(config.engines)]
        for engine in engines:
            stack.callback(engine.socket.close)
        capacity_hz(engines, _WARM_UP_S)
        before_hz = capacity_hz(engines, config.seconds)
        phases = {
            f"{load:g}": offer(engines, load * before_hz, config.seconds, seed)
            for seed, load in enumerate(config.loads)
        }
        after = offer(engines, 0.5 * before_hz, config.seconds, len(config.loads))
        time.sleep(_WINDOW_S)
        after_hz = capacity_hz(engines, config.seconds / 2)
    limits = (config.deadline_us, config.way_us)
    return {
        "capacity_hz": round(before_hz, 1),
        "capacity_after_hz": round(after_hz, 1),
        "loads": {load: summary(phase, *limits) for load, phase in phases.items()},
        "recovery_s": round(recovery_s(after, *limits), 3),
    }


def _table(measured: dict[str, Any]) -> Table:
    capacity = f"capacity {measured['capacity_hz']:,.0f} frames/s, {measured['capacity_after_hz']:,.0f} at the end"
    table = Table(title=f"{capacity}; recovered {measured['recovery_s']:.2f} s after")
    table.add_column("")
    for load in measured["loads"]:
        table.add_column(f"{load} x", justify="right")
    for name in dict.fromkeys(name for rows in measured["loads"].values() for name in rows):
        table.add_row(name, *(f"{rows.get(name, 0.0):,.2f}" for rows in measured["loads"].values()))
    return table


def main() -> None:
    """Command line."""
    config = tyro.cli(Overload, description=__doc__)
    measured = measure(config)
    failed = shortcomings(measured, config.deadline_us)
    if config.json:
        print(json.dumps({**measured, "shortcomings": failed}))
    else:
        Console(file=sys.stdout).print(_table(measured))
        print("\n".join(failed))
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
