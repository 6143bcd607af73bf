"""Inputs by the million: from a target and a seed to what came of them, by outcome.

This module knows nothing about what the targets check. Where atheris can be imported (x86-64) it leads by coverage;
everywhere, inputs are drawn by changing seeds and earlier inputs that came to something new.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import NamedTuple, Protocol

__all__ = ["MAX_INPUT_BYTES", "Tally", "Target", "lead", "mutate"]

MAX_INPUT_BYTES = 4096
_CLOCK_EVERY = 256  # inputs between two looks at the clock
_MAX_KEPT = 512


class Target(Protocol):
    """Something to throw bytes at."""

    seeds: list[bytes]

    def run(self, data: bytes) -> str:
        """Take one input; what came of it. Raises where a promise is broken."""

    def change(self, data: bytes, random: Random) -> bytes:
        """Another input, near this one."""


class Tally(NamedTuple):
    """How many inputs came to what, and how long they took."""

    outcomes: Counter[str]
    seconds: float

    @property
    def inputs(self) -> int:
        """All of them."""
        return self.outcomes.total()


def mutate(
    target: Target, seed: int, inputs: int, seconds: float, clock: Callable[[], float] = time.monotonic
) -> Tally:
    """Run seeds, then changed inputs, until there were `inputs` or `seconds` are over. Raises what the target raises.

    The input at fault is added to the exception as a note.
    """
    random, outcomes, begun = Random(seed), Counter[str](), clock()
    corpus = list(target.seeds)
    for number in range(inputs):
        if number % _CLOCK_EVERY == 0 and clock() - begun > seconds:
            break
        data = corpus[number] if number < len(target.seeds) else target.change(random.choice(corpus), random)
        data = data[:MAX_INPUT_BYTES]
        try:
            outcome = target.run(data)
        except BaseException as error:
            error.add_note(f"input {number} of seed {seed}: {data.hex()}")
            raise
        outcomes[outcome] += 1
        # Rare outcomes lead to rarer ones; the corpus stays bounded, its seeds stay in it.
        if number >= len(target.seeds) and outcomes[outcome] & (outcomes[outcome] - 1) == 0:
            corpus.append(data)
            if len(corpus) > _MAX_KEPT:
                del corpus[random.randrange(len(target.seeds), len(corpus))]
    return Tally(outcomes, clock() - begun)


def lead(target: Target, corpus: Path, seed: int, inputs: int, seconds: float, report: Callable[[Tally], None]) -> None:
    """As `mutate`, led by what the inputs reach in those modules that were imported under atheris.

    Never returns: the process ends after `report`, with 0, or as libFuzzer ends it when the target raises; the input at
    fault is then printed, and lies in the working directory.
    """
    import atheris

    outcomes, begun, left = Counter[str](), time.monotonic(), inputs

    def run(data: bytes) -> None:
        nonlocal left
        outcomes[target.run(data)] += 1
        left -= 1
        if left == 0 or (left % _CLOCK_EVERY == 0 and time.monotonic() - begun > seconds):
            report(Tally(outcomes, time.monotonic() - begun))
            os._exit(0)  # libFuzzer has no other way out

    def change(data: bytes, max_size: int, number: int) -> bytes:
        random = Random(number)
        if random.random() < 0.1:
            return atheris.Mutate(data, max_size)
        # Decoders are in C, where atheris does not see how near to a message an input is: back to the seeds, then.
        return target.change(random.choice((data, random.choice(target.seeds))), random)[:max_size]

    for number, data in enumerate(target.seeds):
        (corpus / str(number)).write_bytes(data)
    options = [f"-max_len={MAX_INPUT_BYTES}", f"-seed={seed + 1}", "-verbosity=0", "-print_final_stats=0"]
    atheris.Setup(["fuzz", *options, str(corpus)], run, custom_mutator=change)
    atheris.Fuzz()
