"""What is gained when turns of several connections are inferred as one batch?

    python -m benchmarks.together [--json]

Engines with a few bots each take their turns in process, one engine after the other and all of them together
(`bot_runtime.together`); what is checked, drawn, allocated and kept of each stays its own either way. The *ratio* is
that of the time of a whole turn of all engines, one by one to together: their median, as they take turns within one
run. *Equal* says whether all queries and actions of both were the same to the last bit.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro

from benchmarks.recorded import RecordedFrames
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from bot_runtime.turns import Actions, Queries
from bot_runtime.work import Steps, finished

__all__ = ["Found", "Together", "measure"]


@dataclass(frozen=True)
class Together:
    """Time engines one by one and together."""

    bundle: Path = Path("bundles/hard")
    engines: tuple[int, ...] = (4, 16)
    bots: tuple[int, ...] = (1, 4, 8)  # of each engine
    turns: int = 200
    json: bool = False  # print one JSON line instead of a table


class Found(NamedTuple):
    """µs of a turn of all engines, medians, the median ratio, and whether all numbers were equal."""

    apart_us: float
    together_us: float
    ratio: float
    equal: bool


class _Engines:
    """Their bots, which take the same turns whichever way they are taken."""

    def __init__(self, bundle: Bundle, golden: Any, engines: int, n_bots: int) -> None:
        self.bots = Bots(bundle, max_bots=engines * n_bots)
        self._handles = [self.bots.start(n_bots) for _ in range(engines)]
        self._frames = RecordedFrames(bundle.manifest.features, golden, engines * n_bots)
        self._engines = engines

    def turn(self, frame: int, *, together: bool) -> tuple[float, list[Queries], list[Actions]]:
        """µs of a turn of all, without what they do between its halves, and what came of it."""
        free = np.split(self._frames.free(frame), self._engines)
        named = list(zip(self._handles, free, strict=True))
        asked_us, queries = self._taken([self.bots.query_steps(bots, frame, each) for bots, each in named], together)
        known_ND = self._frames.known(frame, np.concatenate([each.query_NM for each in queries]))
        known = zip(self._handles, queries, np.split(known_ND, self._engines), strict=True)
        acted_us, actions = self._taken(
            [self.bots.feature_steps(bots, frame, each.query_NM, costly) for bots, each, costly in known], together
        )
        return asked_us + acted_us, queries, actions

    def _taken(self, steps: Sequence[Steps[Any]], together: bool) -> tuple[float, list[Any]]:
        begun_ns = time.perf_counter_ns()
        taken = self.bots.together.finished(steps) if together else [finished(each) for each in steps]
        return (time.perf_counter_ns() - begun_ns) / 1e3, taken


def measure(options: Together) -> dict[tuple[int, int], Found]:
    """By engines and bots of each."""
    bundle = Bundle.load(options.bundle)
    golden = read_golden((options.bundle / "golden.npz").read_bytes(), bundle.manifest)
    found = {}
    for engines in options.engines:
        for n_bots in options.bots:
            apart, joined = (_Engines(bundle, golden, engines, n_bots) for _ in range(2))
            us, equal = np.empty((options.turns, 2)), True
            for frame in range(options.turns):
                us[frame, 0], *alone = apart.turn(frame, together=False)
                us[frame, 1], *all_of_them = joined.turn(frame, together=True)
                equal &= _bits(*alone) == _bits(*all_of_them)
            medians = np.median(us, axis=0).tolist()
            found[engines, n_bots] = Found(*medians, float(np.median(us[:, 0] / us[:, 1])), equal)
    return found


def _bits(queries: list[Queries], actions: list[Actions]) -> bytes:
    asked = b"".join(each.query_NM.tobytes() + each.probs_NM.tobytes() for each in queries)
    return asked + b"".join(each.action_NA.tobytes() for each in actions)


def main() -> None:
    """Measure and print."""
    options = tyro.cli(Together, description=__doc__)
    found = measure(options)
    if options.json:
        print(json.dumps({f"{engines}x{bots}": row._asdict() for (engines, bots), row in found.items()}))
        return
    print("engines x bots   one by one, µs   together, µs   ratio   equal")
    for (engines, bots), (apart_us, together_us, ratio, equal) in found.items():
        shown = "bit by bit" if equal else "not to the last bit"
        print(f"{engines:7} x {bots:<4}   {apart_us:14.0f}   {together_us:12.0f}   {ratio:5.2f}   {shown}")


if __name__ == "__main__":
    main()
