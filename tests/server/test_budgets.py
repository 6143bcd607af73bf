"""Budgets over the wire: a bot's own, one shared by a frame, and both by the connection's own costs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.work import finished
from protocol.client import BotClient
from protocol.codec import Format
from protocol.errors import BadShape, FrameReused
from protocol.features import CostModel
from protocol.messages import Hello
from server.connections import Connections
from server.handlers import Handlers
from server.serving import Serving
from server.servings import Servings
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE
from tests.server.serving import Served, free_numbers

N = 3
SEEDS = [5, 6, 7]


def test_without_a_limit_the_budget_is_what_everything_costs_on_this_connection(tmp_path: Path) -> None:
    serving = Serving(Bundle.load(make_bundle(tmp_path, budget=1.0)), max_bots=1)
    manifest, servings = serving.manifest, Servings(max_bots=1)
    servings.activate(serving)
    handlers = Handlers(servings, Connections(2, 1.0), None)
    model = CostModel(1000.0, (3.0,) * manifest.features.n_queries)
    for hello, full_us in ((Hello(cost_model=model), model.full_us), (Hello(), manifest.budget_us)):
        assert finished(handlers.steps(hello, None, Format.MSGPACK)).budget_us == full_us


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_costs_and_budgets_are_by_the_connections_own_cost_model(served: Served, door: str) -> None:
    """Two engines at once whose rays cost differently, the second one's ten times the first one's."""
    models = [CostModel(3.0 * k, tuple((2.0 + i) * k for i in range(TABLE.n_queries))) for k in (1.0, 10.0)]
    with BotClient(served.addresses[door]) as first, BotClient(served.addresses[door]) as second:
        engines, most_us = [], np.zeros((2, N))
        for client, model in zip((first, second), models, strict=True):
            assert client.hello(cost_model=model).cost_model == model
            engines.append((client, model, client.start(N, seeds=SEEDS, budgets_us=[0.0, 20.0, 1e6])))
        for frame in range(20):
            for row, (client, model, bots) in enumerate(engines):
                queries = client.query(bots, frame, free_numbers(TABLE, N, frame))
                assert queries.cost_us == pytest.approx(model.query_cost_us(queries.queries))
                most_us[row] = np.maximum(most_us[row], queries.cost_us)
        assert not most_us[:, 0].any()
        assert 10.0 < most_us[0, 1] <= 20.0
        assert most_us[1, 1] == 0.0  # one feature and the call cost the second engine 50
        assert most_us[1, 2] == 10.0 * most_us[0, 2] > 50.0


def test_a_cost_model_prices_every_costly_feature(served: Served) -> None:
    with BotClient(served.addresses["http"]) as client, pytest.raises(BadShape, match=f"expected {TABLE.n_queries}"):
        client.hello(cost_model=CostModel(0.0, (1.0,)))


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_a_budget_of_the_frame_is_shared_by_the_messages_bots(served: Served, door: str) -> None:
    with BotClient(served.addresses[door]) as client:
        client.hello()
        bots, alone = client.start(N, seeds=SEEDS, budgets_us=[1e6] * N), client.start(N, seeds=SEEDS)
        for frame in range(20):
            free = free_numbers(TABLE, N, frame)
            shared = client.query(bots, frame, free, frame_budget_us=5.0)
            assert 0.0 < shared.cost_us.sum() <= 5.0 < client.query(alone, frame, free).cost_us.sum()
            assert client.query(bots, frame, free, frame_budget_us=5.0).cost_us.tolist() == shared.cost_us.tolist()
            with pytest.raises(FrameReused):
                client.query(bots, frame, free, frame_budget_us=6.0)
