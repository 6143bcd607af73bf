"""Measured costs over the wire: each connection's own, from its own measurements, for all to see."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from bot_runtime import costs
from protocol.client import BotClient
from protocol.errors import FrameReused, NonFinite, OutOfRange
from protocol.features import CostModel
from tests.protocol.golden import TABLE
from tests.server.serving import Served, costly_numbers, free_numbers, http_request, serve

N = 3
SHARED_US = 12.0


def play(client: BotClient, bots: np.ndarray, frames: range, us_per_declared_us: float | None) -> np.ndarray:
    """Turns within a shared budget on an engine whose features cost a multiple of what is declared; its µs a frame."""
    declared, spent_us = CostModel.declared(TABLE), []
    for frame in frames:
        queries = client.query(bots, frame, free_numbers(TABLE, N, frame), frame_budget_us=SHARED_US)
        assert queries.cost_us.sum() <= SHARED_US
        measured_us = (us_per_declared_us or 1.0) * float(declared.query_cost_us(queries.queries).sum())
        acquire_us = None if us_per_declared_us is None else measured_us
        client.act(bots, frame, queries.queries, costly_numbers(TABLE, N, frame), acquire_us=acquire_us)
        spent_us.append(measured_us)
    return np.array(spent_us)


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_a_connections_budgets_are_kept_by_its_own_measurements(served: Served, door: str) -> None:
    """Two engines at once: the rays of one cost three times what is declared, the other says nothing."""
    with BotClient(served.addresses[door]) as measuring, BotClient(served.addresses[door]) as silent:
        assert measuring.hello().cost_quantile == costs.QUANTILE
        silent.hello()
        bots = [client.start(N, seeds=[1, 2, 3], budgets_us=[1e6] * N) for client in (measuring, silent)]
        measured_us = play(measuring, bots[0], range(150), 3.0)
        declared_us = play(silent, bots[1], range(150), None)
        assert (measured_us[:5] > SHARED_US).any()
        assert (measured_us[50:] > 0.0).any()
        assert not (measured_us[50:] > SHARED_US).any()
        assert (declared_us > SHARED_US / 2.0).any()
        assert not (declared_us > SHARED_US).any()
        assert silent.query(bots[1], 150, free_numbers(TABLE, N, 150)).cost_us.sum() > 0.0


def test_a_retry_measures_nothing_and_a_refusal_neither(served: Served) -> None:
    with BotClient(served.addresses["http"]) as client:
        client.hello(cost_model=CostModel(5.0, (3.0,) * TABLE.n_queries))
        bots = client.start(N, seeds=[1, 2, 3], budgets_us=[1e6] * N)
        queries = client.query(bots, 0, free_numbers(TABLE, N, 0))
        turn = (bots, 0, queries.queries, costly_numbers(TABLE, N, 0))
        for wrong, error in ((float("nan"), NonFinite), (-0.5, OutOfRange), (1.1e9, OutOfRange)):
            with pytest.raises(error, match="acquire_us"):
                client.act(*turn, acquire_us=wrong)
        first = client.act(*turn, acquire_us=80.0)
        again = client.act(*turn, acquire_us=80.0)
        assert again.actions.tobytes() == first.actions.tobytes()
        assert again.infer_us == first.infer_us
        for other in (81.0, None):
            with pytest.raises(FrameReused):
                client.act(*turn, acquire_us=other)
        mine = reports(served)[-1]
        assert (mine["frames"], mine["rows"][0]["declared_us"]) == (1, 5.0)


def reports(served: Served, **headers: str) -> list[dict]:
    answer = http_request(served.addresses["http"], "GET", "/v1/costs", headers=headers)
    assert answer.status == 200
    return json.loads(answer.body)


def test_costs_are_there_to_see_and_name_nobody(
    served: Served, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = len(reports(served))
    with BotClient(served.addresses["tcp"]) as client:
        connection = client.hello().connection
        play(client, client.start(N, seeds=[1, 2, 3], budgets_us=[1e6] * N), range(30), 2.0)
        body = http_request(served.addresses["http"], "GET", "/v1/costs").body
        assert connection.encode() not in body
        seen = json.loads(body)
        assert len(seen) == before + 1
        rows = {row["group"]: row for row in seen[-1]["rows"]}
        assert set(rows) == {"call", "1.5 µs", "4.5 µs"}
        assert rows["1.5 µs"]["declared_us"] < rows["1.5 µs"]["estimated_us"] <= rows["1.5 µs"]["charged_us"]
    assert len(reports(served)) == before
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(body)))
    costs.main()
    assert "4.5 µs" in capsys.readouterr().out


def test_the_costs_need_the_token(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", token="s3cret") as guarded:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "s3cret"}):
            refused = http_request(guarded.addresses["http"], "GET", "/v1/costs", headers=headers)
            assert (refused.status, json.loads(refused.body)["code"]) == (401, "UNAUTHORIZED")
        assert reports(guarded, Authorization="Bearer s3cret") == []
