"""A bundle without a context and one for every budget, served for real: end to end by every door."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from protocol.client import BotClient
from protocol.errors import BadSchema, BadShape, FrameReused, NonFinite, OutOfRange
from protocol.features import CostModel
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE, VECTORS, WELCOME
from tests.server.serving import Served, costly_numbers, free_numbers, http_request, serve

N = 3
SEEDS = [5, 6, 7]
MODEL = CostModel(5.0, tuple(2.0 + i for i in range(TABLE.n_queries)))  # 70 µs in all
DOORS = ["http", "tcp", "unix", "ws"]


def _serve(folder: Path, **kind: object) -> Iterator[tuple[Served, Bundle]]:
    path = make_bundle(folder / "bundle", features=TABLE, action=WELCOME.action, **kind)
    with serve(path, folder / "s") as running:
        yield running, Bundle.load(path)


@pytest.fixture(scope="module")
def memoryless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, Bundle]]:
    yield from _serve(tmp_path_factory.mktemp("memoryless"), context_length=1, method="rcbc", budget=0.6)


@pytest.fixture(scope="module")
def conditioned(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Served, Bundle]]:
    yield from _serve(tmp_path_factory.mktemp("conditioned"), target_cost=0.3, budget=1.0)


def _same_play(client: BotClient, bundle: Bundle, frames: list[dict[str, object]], **start: object) -> np.ndarray:
    """Play over the wire and on the bots themselves, one turn a frame; costs in µs, [frames, N], the same for both."""
    bots = Bots(bundle)
    near, far = bots.start(N, seeds=SEEDS, cost_model=MODEL, **start), client.start(N, seeds=SEEDS, **start)
    costs = []
    for frame, limits in enumerate(frames):
        free, costly = free_numbers(TABLE, N, frame), costly_numbers(TABLE, N, frame)
        wanted = bots.request_queries(near, frame, free, [0.25] * N, **limits)
        got = client.query(far, frame, free, [0.25] * N, **limits)
        assert np.array_equal(got.queries, wanted.query_NM)
        action_NA = bots.submit_features(near, frame, wanted.query_NM, costly).action_NA
        assert np.array_equal(client.act(far, frame, got.queries, costly).actions, action_NA)
        costs.append(got.cost_us)
    client.stop(far)
    return np.array(costs)


@pytest.mark.parametrize("door", DOORS)
def test_a_bundle_without_a_context_plays(memoryless: tuple[Served, Bundle], door: str) -> None:
    served, bundle = memoryless
    with BotClient(served.addresses[door]) as client:
        welcome = client.hello(cost_model=MODEL)
        assert (welcome.context_length, welcome.target_cost_us) == (1, None)
        assert _same_play(client, bundle, [{}] * 12).any()
        ignored = {"target_costs_us": [1.0] * N}
        assert np.array_equal(_same_play(client, bundle, [ignored] * 12), _same_play(client, bundle, [{}] * 12))


@pytest.mark.parametrize("door", DOORS)
def test_one_bundle_plays_every_budget(conditioned: tuple[Served, Bundle], door: str) -> None:
    served, bundle = conditioned
    with BotClient(served.addresses[door]) as client:
        welcome = client.hello(cost_model=MODEL)
        assert welcome.budget_us == MODEL.full_us
        assert welcome.target_cost_us == pytest.approx(0.3 * MODEL.full_us)
        default = _same_play(client, bundle, [{}] * 12)
        said = _same_play(client, bundle, [{}] * 12, target_costs_us=[0.3 * MODEL.full_us] * N)
        assert np.array_equal(said, default)
        other = _same_play(client, bundle, [{}] * 12, target_costs_us=[0.0] * N)
        assert not np.array_equal(other, default)
        by_frame = _same_play(client, bundle, [{"target_costs_us": [0.0] * N}] * 12)
        assert np.array_equal(by_frame, other)
        limits_us = [[10.0 + frame, 70.0, 0.0] for frame in range(12)]
        costs_us = _same_play(client, bundle, [{"budgets_us": limit} for limit in limits_us], budgets_us=[5.0] * N)
        assert (costs_us <= np.array(limits_us)).all()
        assert (costs_us[:, :2] > 5.0).any(axis=0).all()
        shared = {"frame_budget_us": 30.0, "target_costs_us": [70.0] * N}
        assert (_same_play(client, bundle, [shared] * 12).sum(axis=1) <= 30.0).all()


@pytest.mark.parametrize("door", DOORS)
def test_limits_of_a_frame_are_checked_and_part_of_a_retry(conditioned: tuple[Served, Bundle], door: str) -> None:
    with BotClient(conditioned[0].addresses[door]) as client:
        client.hello()
        bots, free = client.start(N), free_numbers(TABLE, N, 0)
        for name in ("budgets_us", "target_costs_us"):
            for error, numbers in ((BadShape, [1.0]), (OutOfRange, [0.0, 0.0, -1.0]), (OutOfRange, [0.0, 1.1e9, 0.0])):
                with pytest.raises(error, match=name):
                    client.query(bots, 0, free, **{name: numbers})
            with pytest.raises(NonFinite, match=name):
                client.query(bots, 0, free, **{name: [0.0, np.nan, 0.0]})
            with pytest.raises((BadShape, OutOfRange), match=name):
                client.start(N, **{name: [-1.0, 0.0, 0.0]})
            with pytest.raises(BadSchema):
                client.exchange({"type": "start_bots", "count": 1, name: 5.0})
        limits = {"budgets_us": [9.0] * N, "target_costs_us": [8.0] * N}
        first = client.query(bots, 0, free, **limits)
        again = client.query(bots, 0, free, **limits)
        assert (again.queries.tolist(), again.infer_us) == (first.queries.tolist(), first.infer_us)
        for other in ({}, {"budgets_us": [9.0] * N}, {**limits, "target_costs_us": [8.0, 8.0, 7.0]}):
            with pytest.raises(FrameReused):
                client.query(bots, 0, free, **other)


def test_a_client_that_knows_no_target_costs_plays_on(conditioned: tuple[Served, Bundle]) -> None:
    """The golden frames that leave every new field out, as JSON and as msgpack."""
    address = conditioned[0].addresses["http"]
    forms = (
        ("application/json", lambda message: json.dumps(message).encode(), json.loads),
        ("application/msgpack", msgpack.packb, msgpack.unpackb),
    )
    for content_type, pack, unpack in forms:
        headers = {"Content-Type": content_type}
        hello = http_request(address, "POST", "/v1/connections", pack(VECTORS["hello"].message), headers)
        headers["X-Bot-Connection"] = unpack(hello.body)["connection"]
        started = http_request(address, "POST", "/v1/bots/start", pack(VECTORS["start_bots"].message), headers)
        message = {**VECTORS["request_queries"].message, "bots": unpack(started.body)["bots"][:1]}
        asked = http_request(address, "POST", "/v1/query", pack(message), headers)
        assert (asked.status, len(unpack(asked.body)["cost_us"])) == (200, 1)
        http_request(address, "POST", "/v1/connections/close", pack({}), headers)


def test_the_summary_says_the_target_cost(conditioned: tuple[Served, Bundle], served: Served) -> None:
    for running, target_cost in ((conditioned[0], 0.3), (served, None)):
        summary = json.loads(http_request(running.addresses["http"], "GET", "/v1/bundle").body)
        assert summary["target_cost"] == target_cost
