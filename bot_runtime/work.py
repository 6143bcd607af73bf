"""Work: a graph that a turn needs to be run before it can go on.

This module knows nothing about turns. What takes one is written as a generator, which is sent how long its work took;
whoever drives it runs that work at once, or together with that of others (`bot_runtime.together`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from functools import wraps
from typing import Literal, ParamSpec, TypeVar

from msgspec import Struct

from bot_runtime.batch import Batch

__all__ = ["Graph", "Steps", "Work", "alone", "finished", "go_on"]

Graph = Literal["query_probs", "act"]
T = TypeVar("T")
P = ParamSpec("P")


class Work(Struct, frozen=True, eq=False):  # made anew for every graph: a tuple with names takes three times as long
    """Run `graph` for a batch whose inputs are written, by `run`. `clock` counts ns."""

    graph: Graph
    run: Callable[[Batch], None]
    batch: Batch
    clock: Callable[[], int]

    def done_us(self) -> float:
        """Do it; how many µs that took."""
        started_ns = self.clock()
        self.run(self.batch)
        return (self.clock() - started_ns) / 1e3


Steps = Generator[Work, float, T]
"""What comes to T in the end, and the work on the way. What it returns or raises in between is final."""


def go_on(steps: Steps[T], work: Work) -> Work:
    """Do the work of these steps, and what they then ask for. What fails fails in them."""
    try:
        us = work.done_us()
    except Exception as error:
        return steps.throw(error)
    return steps.send(us)


def finished(steps: Steps[T]) -> T:
    """Do its work as it comes up."""
    try:
        work = next(steps)
        while True:
            work = go_on(steps, work)
    except StopIteration as end:
        result: T = end.value
        return result


def alone(begun: Callable[P, Steps[T]]) -> Callable[P, T]:
    """The function or method that is `finished` before it returns."""

    @wraps(begun)
    def run(*args: P.args, **named: P.kwargs) -> T:
        return finished(begun(*args, **named))

    return run
