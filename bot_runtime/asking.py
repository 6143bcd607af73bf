"""A turn's first half: what each bot asks for, or, where the engine has decided that, what its step needs beside it.

This module knows nothing about handles, messages or retries. It changes no bot.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bot_runtime.company import Company
from bot_runtime.context import Contexts
from bot_runtime.draw import Asker, draw, finite_rows, timed_us
from bot_runtime.request import Request
from bot_runtime.turns import Queries, Turn

__all__ = ["Asking"]


class Asking:
    """Begins turns of the bots of one arena. `clock` counts ns."""

    def __init__(self, n_queries: int, contexts: Contexts, clock: Callable[[], int]) -> None:
        self._n_queries, self._contexts, self._clock = n_queries, contexts, clock

    def ask(
        self, policy: Asker, company: Company, frame: int, request: Request, returns_to_go_N: NDArray[np.float64]
    ) -> Turn:
        """A turn whose query is drawn here, within the request's limits."""
        batch, means = company.batch, request.means
        batch.begin(request.free_NF, returns_to_go_N, means.terms.target_cost_N)
        noise_NX = self._contexts.noise(batch)
        drawn = draw(policy, batch, noise_NX, means, request.limits.frame_budget_us, self._clock)
        for array in (drawn.query_NM, drawn.cost_us_N, drawn.probs_NM):
            array.flags.writeable = False
        queries = Queries(frame, drawn.query_NM, drawn.cost_us_N, drawn.probs_NM, drawn.infer_us)
        noise_NA = noise_NX[:, self._n_queries :]
        return Turn(frame, company.handles_N, request.content, queries, noise_NA, drawn.asks_N, request.budget_us)

    def decided(
        self, policy: Asker, company: Company, request: Request, returns_to_go_N: NDArray[np.float64], queries: Queries
    ) -> Turn:
        """A turn whose query came with it. A bot that acquired something had a query, whatever the network says."""
        batch = company.batch
        batch.begin(request.free_NF, returns_to_go_N, request.means.terms.target_cost_N)
        infer_us = timed_us(self._clock, policy.query_probs, batch)
        asks_N = finite_rows(batch.probs_NM)
        if asks_N is not None:
            asks_N |= queries.query_NM.any(axis=1)
            asks_N = None if asks_N.all() else asks_N
        noise_NA = self._contexts.noise(batch)[:, self._n_queries :]
        queries = queries._replace(probs_NM=batch.probs_NM.copy(), infer_us=infer_us)
        content, budget_us = request.content, request.budget_us
        return Turn(queries.frame, company.handles_N, content, queries, noise_NA, asks_N, budget_us, taken=True)
