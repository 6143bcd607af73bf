"""Together: the turns of several messages, each with bots of its own, whose graphs are run for all of them at once.

This module knows nothing about messages, connections or what is done in a turn. All that is not a graph stays each
turn's own: what is wrong with one is raised in its own steps, before or after, and touches no other.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from bot_runtime.context import Contexts
from bot_runtime.work import Graph, Steps, Work, go_on

__all__ = ["BOUNDS", "MAX_BOTS_EACH", "Together"]

MAX_BOTS_EACH = 8
"""A batch of more gains nothing from another's company: its own arithmetic is most of what it takes, and copying the
contexts of bots that do not lie side by side takes more than a second call (docs/adr/0019)."""

BOUNDS = (2, 4, 8, 16, 32, 64)
"""Of the histogram of how many batches were run as one."""
_MAX_KNOWN = 256  # batches of other shapes, a few kB each


class _Waiting(NamedTuple):
    number: int
    steps: Steps[Any]
    work: Work


class Together:
    """Runs work of one arena's batches. `counts[j]` is how often as many batches as BOUNDS[j] or fewer were one."""

    def __init__(self, contexts: Contexts) -> None:
        self.counts = [0] * (len(BOUNDS) + 1)
        self.n_batches = 0  # of all those runs
        self._contexts = contexts
        self._outputs = contexts.more_outputs()
        self._known: dict[tuple[int | None, int], Batch] = {}  # by first row, if they lie side by side, and bots

    def finished(self, turns: Sequence[Steps[Any]]) -> list[Any]:
        """What each comes to; none may raise. No bot may be in two of them.

        Each is sent its bots' share of the time: that others came along says nothing about how fast its bundle is.
        """
        results: list[Any] = [None] * len(turns)
        waiting: list[_Waiting] = []

        def advance(number: int, steps: Steps[Any], resume: Callable[[], Work]) -> None:
            try:
                work = resume()
                while work.batch.copies is not None or work.batch.n_bots > MAX_BOTS_EACH:
                    work = go_on(steps, work)  # at once: the batch's copies are in memory that all share
            except StopIteration as end:
                results[number] = end.value
            else:
                waiting.append(_Waiting(number, steps, work))

        for number, steps in enumerate(turns):
            advance(number, steps, steps.__next__)
        while waiting:
            graph = waiting[0].work.graph
            ready = [each for each in waiting if each.work.graph == graph]
            waiting = [each for each in waiting if each.work.graph != graph]
            for each, resume in self._run(graph, ready):
                advance(each.number, each.steps, resume)
        return results

    def _run(self, graph: Graph, ready: list[_Waiting]) -> Iterator[tuple[_Waiting, Callable[[], Work]]]:
        """Run a graph for all; then each with what goes on with it, to be done before the next is asked for."""
        if len(ready) == 1:
            yield ready[0], partial(go_on, ready[0].steps, ready[0].work)
            return
        ordered = sorted(ready, key=lambda each: int(each.work.batch.slots_N[0]))
        slots_N = np.concatenate([each.work.batch.slots_N for each in ordered])
        before_query, whole = graph == "query_probs", self._whole(slots_N)
        whole.fetch(slots_N, before_query=before_query)
        try:
            us = replace(ordered[0].work, batch=whole).done_us()
        except Exception as error:  # each fails as it would have alone
            for each in ready:
                yield each, partial(each.steps.throw, error)
            return
        first = 0
        for each in ordered:
            each.work.batch.take_outputs(whole, first, before_query=before_query)
            first += each.work.batch.n_bots
            yield each, partial(each.steps.send, us * each.work.batch.n_bots / slots_N.size)
        self.counts[bisect_left(BOUNDS, len(ready))] += 1
        self.n_batches += len(ready)

    def _whole(self, slots_N: NDArray[np.int64]) -> Batch:
        """A batch that can stand for the bots of these slots, which come in runs, the lowest first."""
        first, n_bots = int(slots_N[0]), slots_N.size
        side_by_side = int(slots_N[-1]) - first + 1 == n_bots  # for each run's are, and none is there twice
        key = first if side_by_side else None, n_bots
        whole = self._known.get(key)
        if whole is None:
            if len(self._known) == _MAX_KNOWN:
                del self._known[next(iter(self._known))]
            whole = self._known[key] = self._contexts.batch(slots_N, self._outputs)
        return whole
