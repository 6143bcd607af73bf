"""A turn's first half: what each bot asks for, or, where the engine has decided that, what its step needs beside it.

This module knows nothing about handles, messages or retries. It changes no bot.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bot_runtime.company import Company
from bot_runtime.context import Contexts
from bot_runtime.deadline import Deadline
from bot_runtime.draw import Asker, draw
from bot_runtime.fallback import Cause
from bot_runtime.haste import Haste
from bot_runtime.request import Request
from bot_runtime.turns import Queries, Turn
from bot_runtime.work import Steps, Work

__all__ = ["Asking"]


class Asking:
    """Begins turns of the bots of one arena. `clock` counts ns."""

    def __init__(self, n_queries: int, contexts: Contexts, haste: Haste, clock: Callable[[], int]) -> None:
        self._n_queries, self._contexts, self._haste, self._clock = n_queries, contexts, haste, clock

    def ask(
        self,
        policy: Asker,
        company: Company,
        frame: int,
        request: Request,
        returns_to_go_N: NDArray[np.float64],
        deadline: Deadline | None = None,
    ) -> Steps[Turn]:
        """A turn whose query is drawn here, within the request's limits; of nothing where there is no time for that.

        Raises NotReady where the deadline has passed and the request was refused.
        """
        n_bots, queries, allowed_us = company.n_bots, None, 0.0
        noise_NX = self._contexts.noise(company.batch)
        cause = self._haste.cause_against(deadline, n_bots, "query_probs")
        if deadline is not None or cause is not None:
            queries = Queries.of_nothing(frame, n_bots, self._n_queries, cause or Cause.DEADLINE)
        if deadline is not None:
            allowed_us = deadline.left_us()
            deadline.offer(queries)
        if cause is None:
            batch, means = company.batch, request.means
            batch.begin(request.free_NF, returns_to_go_N, means.terms.target_cost_N)
            infer_us = yield Work("query_probs", policy.query_probs, batch, self._clock)
            self._haste.observe("query_probs", n_bots, infer_us)
            drawn = draw(batch, frame, noise_NX, means, request.limits.frame_budget_us, infer_us)
            if deadline is None or self._haste.settle(deadline, n_bots, allowed_us, infer_us, "query_probs"):
                queries = drawn
        assert queries is not None  # it is drawn, or there is a cause, or a deadline has passed
        return self._turn(company, request, returns_to_go_N, queries, noise_NX, cause is None)

    def decided(
        self,
        company: Company,
        frame: int,
        request: Request,
        returns_to_go_N: NDArray[np.float64],
        query_NM: NDArray[np.bool_],
        cost_us_N: NDArray[np.float64],
    ) -> Turn:
        """A turn whose query came with it: the network is not asked, only run for what its step needs."""
        noise_NX = self._contexts.noise(company.batch)
        probs_NM = np.broadcast_to(np.float32(0.0), query_NM.shape)
        queries = Queries(frame, query_NM, cost_us_N, probs_NM, 0.0)
        turn = self._turn(company, request, returns_to_go_N, queries, noise_NX, False)
        turn.taken = True
        return turn

    def _turn(
        self,
        company: Company,
        request: Request,
        returns_to_go_N: NDArray[np.float64],
        queries: Queries,
        noise_NX: NDArray[np.float32],
        is_prepared: bool,
    ) -> Turn:
        return Turn(
            queries.frame,
            company.handles_N,
            request.content,
            queries,
            noise_NX[:, self._n_queries :],
            request.budget_us,
            returns_to_go_N,
            request.means.terms.target_cost_N,
            is_prepared,
        )
