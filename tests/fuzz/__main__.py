"""The long form: one target, as many inputs as there is time for.

    python -m tests.fuzz turn --minutes 60

Prints what came of the inputs; ends with another code than 0 when one of them broke a promise.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from tests.fuzz.campaign import Tally, Target, lead, mutate

_INSTRUMENTED = ["protocol", "bot_runtime", "server"]


@dataclass(frozen=True)
class Fuzz:
    """Throw changed inputs at one target."""

    target: tyro.conf.Positional[Literal["codec", "replies", "turn", "recording", "manifest"]]
    minutes: float = 1.0
    inputs: int = 10**7  # whichever comes first
    seed: int = 0
    engine: Literal["coverage", "mutation"] | None = None  # coverage needs atheris; by default where it is installed
    json: bool = False  # print one JSON line

    @property
    def by_coverage(self) -> bool:
        """Whether atheris leads."""
        return self.engine != "mutation" and importlib.util.find_spec("atheris") is not None


def main() -> None:
    """Command line."""
    config = tyro.cli(Fuzz, description=__doc__)
    if config.engine == "coverage" and not config.by_coverage:
        sys.exit("atheris is not installed: it has wheels for x86-64 only")

    def report(tally: Tally) -> None:
        engine = "coverage" if config.by_coverage else "mutation"
        rate = round(tally.inputs / tally.seconds)
        line = {"target": config.target, "engine": engine, "inputs": tally.inputs, "seconds": round(tally.seconds, 1)}
        line |= {"inputs_per_s": rate, "outcomes": dict(tally.outcomes.most_common())}
        text = "\n".join(f"{key:>13}  {value}" for key, value in line.items())
        print(json.dumps(line) if config.json else text, flush=True)

    with tempfile.TemporaryDirectory() as scratch:
        folder, corpus = Path(scratch), Path(scratch) / "corpus"
        target = _target(config, folder)
        if config.by_coverage:
            corpus.mkdir()
            lead(target, corpus, config.seed, config.inputs, 60.0 * config.minutes, report)
        report(mutate(target, config.seed, config.inputs, 60.0 * config.minutes))


def _target(config: Fuzz, folder: Path) -> Target:
    """The target; ours is imported only here, so that atheris can look on."""
    instrumented: contextlib.AbstractContextManager[object] = contextlib.nullcontext()
    if config.by_coverage:
        import atheris

        instrumented = atheris.instrument_imports(include=_INSTRUMENTED, enable_loader_override=False)
    with instrumented:
        from tests.fuzz.targets import TARGETS
    return TARGETS[config.target](folder)


if __name__ == "__main__":
    main()
