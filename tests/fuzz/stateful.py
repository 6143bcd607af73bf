"""A server in memory against the model, in as many runs as wanted: several engines, retries, refusals, gaps, silence.

python -m tests.fuzz.stateful --runs 10000
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from bot_runtime.bundle import Bundle
from tests.bundles import make_bundle
from tests.fuzz.machine import ServerMachine
from tests.fuzz.world import World
from tests.protocol.golden import TABLE, WELCOME

__all__ = ["run_machine"]


def run_machine(
    bundle: Bundle, runs: int, steps: int, *, repeatable: bool = True, phases: Sequence[Phase] = tuple(Phase)
) -> Counter[str]:
    """The server's replies by type or code; raises where server and model differ, with a run that shows it."""
    world = World(bundle)
    quiet = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much]
    how = settings(
        max_examples=runs,
        stateful_step_count=steps,
        derandomize=repeatable,
        phases=phases,
        database=None,
        deadline=None,
        suppress_health_check=quiet,
    )
    run_state_machine_as_test(lambda: ServerMachine(world), settings=how)
    return world.replies


@dataclass(frozen=True)
class Machine:
    """Run the state machine; ends with another code than 0 at the first divergence."""

    runs: int = 10_000
    steps: int = 50
    json: bool = False  # print one JSON line


def main() -> None:
    """Command line."""
    config = tyro.cli(Machine, description=__doc__)
    with tempfile.TemporaryDirectory() as folder:
        bundle = Bundle.load(make_bundle(Path(folder), features=TABLE, action=WELCOME.action))
        begun = time.monotonic()
        replies = run_machine(bundle, config.runs, config.steps, repeatable=False)
    line: dict[str, Any] = {
        "runs": config.runs,
        "steps": config.steps,
        "seconds": round(time.monotonic() - begun, 1),
        "divergences": 0,
    }
    line |= {"replies": dict(replies.most_common())}
    print(json.dumps(line) if config.json else "\n".join(f"{key:>12}  {value}" for key, value in line.items()))


if __name__ == "__main__":
    main()
