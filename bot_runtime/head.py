"""Head: what an engine that runs the acquisition graph itself asks for, exactly as the server would have.

This module knows nothing about servers or sockets. It needs the manifest and `acquisition.onnx` of the bundle that is
served, and of each `actions` reply the hidden state and the number of turns. Sampling, costs, budgets and allocation
are those of `Bots`, by the same code; so is the noise, counted by each bot's seed and turns. So queries equal the
server's to the bit wherever the graph's arithmetic does: the same onnxruntime on the same kind of machine, for the same
bots in the same order.

    head = Head(bundle.manifest, bundle.acquisition, seeds=[7, 8])
    bots, frame = client.start(2, seeds=[7, 8]), 0
    queries = head.ask(frame, free, rewards)                        # no round trip
    actions = client.take(bots, frame, free, queries.query_NM, raycast(queries.query_NM), rewards)
    head.keep(actions.hidden, actions.turns)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from bot_runtime import inputs
from bot_runtime.asking import Asking
from bot_runtime.company import Company, Means
from bot_runtime.context import Contexts
from bot_runtime.costs import Costs
from bot_runtime.haste import Haste
from bot_runtime.manifest import Manifest
from bot_runtime.policy import Acquisition
from bot_runtime.request import NOTHING_SAID, Numbers, Request
from bot_runtime.spending import Spending
from bot_runtime.start import Start
from bot_runtime.turns import Queries
from bot_runtime.work import finished
from protocol.features import CostModel
from protocol.messages import MAX_RETURN
from protocol.values import check_shape

__all__ = ["Head"]


class Head:
    """The head of N bots that are always named together, in one order. Not thread-safe.

    Everything that `start` and `request_queries` would be told, it is told too. An engine whose server learns costs
    gives `costs`, and lets it observe what acquiring took, in the order of its messages: all heads of one connection
    share one `Costs`.
    """

    def __init__(
        self,
        manifest: Manifest,
        acquisition: bytes,
        seeds: Sequence[int],
        *,
        target_returns: Numbers = None,
        budgets_us: Numbers = None,
        target_costs_us: Numbers = None,
        cost_model: CostModel | None = None,
        costs: Costs | None = None,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        """`acquisition` is a verified graph (`Bundle.load`). Raises BadBundle, BadShape, NonFinite, OutOfRange."""
        n_bots, table = len(seeds), manifest.features
        said = Start.checked(
            manifest, seeds, n_bots,
            target_returns=target_returns, budgets_us=budgets_us, target_costs_us=target_costs_us,
            cost_model=cost_model or (costs.declared if costs else None),
        )  # fmt: skip
        slots_N = np.arange(n_bots, dtype=np.int64)
        self._contexts, self._spending = Contexts(manifest, n_bots), Spending(manifest, n_bots)
        said.begin(slots_N, self._contexts, self._spending)
        means = Means.of(self._spending.terms(slots_N, NOTHING_SAID))
        self._company = Company(slots_N, self._contexts.batch(slots_N), means)
        self._checks = inputs.FeatureChecks(table, n_bots)
        self._acquisition, self._asking = (
            Acquisition(manifest, acquisition),
            Asking(table.n_queries, self._contexts, Haste(clock), clock),
        )
        self._costs, self._left_N = costs, said.returns_N

    def ask(
        self,
        frame: int,
        free_NF: NDArray[np.float32],
        rewards: Numbers = None,
        frame_budget_us: float | None = None,
        budgets_us: Numbers = None,
        target_costs_us: Numbers = None,
    ) -> Queries:
        """What each bot asks for in this frame, as `Bots.request_queries` says; to be sent with the same arguments.

        `rewards` came since the last frame that was kept: asking changes nothing yet. Raises BadShape, NonFinite,
        OutOfRange.
        """
        costs = self._costs if self._costs is not None and self._costs.n_frames else None
        request = Request.checked(
            self._checks, self._spending, self._company, free_NF, rewards,
            frame_budget_us, budgets_us, target_costs_us, costs,
        )  # fmt: skip
        self._left_N = self._contexts.returns_to_go(self._company.batch) - request.rewards_N
        return finished(self._asking.ask(self._acquisition, self._company, frame, request, self._left_N)).queries

    def skip(self, rewards: Numbers = None) -> None:
        """This frame's query is asked of the server, which counts these rewards. Raises as `ask` does."""
        n_bots = self._company.n_bots
        counted = np.zeros(n_bots) if rewards is None else rewards
        counted_N = inputs.per_bot("rewards", counted, n_bots, -MAX_RETURN, MAX_RETURN)
        self._left_N = self._contexts.returns_to_go(self._company.batch) - counted_N

    def keep(self, hidden_NW: NDArray[np.float32] | None, turns_N: NDArray[np.int64]) -> None:
        """The frame is over: what the reply says of each bot, and the rewards of `ask` or `skip`.

        `hidden_NW` is None where a deadline passed: it is then what it was. Raises BadShape.
        """
        batch = self._company.batch
        if hidden_NW is not None:
            check_shape("hidden", hidden_NW, batch.past_NW.shape, np.float32)
        check_shape("turns", turns_N, (batch.n_bots,), np.int64)
        self._contexts.follow(batch, hidden_NW, turns_N)
        self._contexts.spend(batch, self._left_N)
