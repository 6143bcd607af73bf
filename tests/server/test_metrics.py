"""/metrics of a real server: what engines did is what it says, in the format that Prometheus reads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from bot_runtime.bundle import Bundle
from protocol.client import BotClient
from protocol.errors import NoBot
from server import families
from server.serving import Serving
from tests.protocol.golden import TABLE, VECTORS
from tests.server.serving import RawStream, Served, costly_numbers, free_numbers, http_request, play, serve

N = 3


class Scrape:
    """One answer of /metrics, read by Prometheus' own parser."""

    def __init__(self, served: Served, **headers: str) -> None:
        answer = http_request(served.addresses["http"], "GET", "/metrics", headers=headers)
        assert answer.status == 200
        assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
        self.families = {family.name: family for family in text_string_to_metric_families(answer.body.decode())}
        self.samples = [sample for family in self.families.values() for sample in family.samples]

    def __call__(self, name: str, **labels: str) -> float:
        """The sum of the samples of this name with these labels, and whatever others."""
        named = [sample for sample in self.samples if sample.name == f"bot_runtime_{name}"]
        found = [sample.value for sample in named if labels.items() <= sample.labels.items()]
        assert found, f"no {name} with {labels}"
        return sum(found)


@pytest.fixture
def server(bundle: Path, tmp_path: Path) -> Served:
    with serve(bundle, tmp_path / "s", max_bots=8, max_connections=5) as running:
        yield running


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_what_happened_is_what_it_says(server: Served, door: str) -> None:
    with BotClient(server.addresses[door]) as client:
        client.hello()
        bots = client.start(N)
        play(client, TABLE, bots, range(4))
        client.query(bots, 7, free_numbers(TABLE, N, 7))
        client.query(bots, 9, free_numbers(TABLE, N, 9))
        with pytest.raises(NoBot):
            client.query(np.array([1]), 9, free_numbers(TABLE, 1, 9))
        scrape = Scrape(server)
        for message, n in (("hello", 1), ("start_bots", 1), ("request_queries", 6), ("submit_features", 4)):
            assert scrape("request_seconds_count", transport=door, message=message) == n
        for phase in ("wait", "decode", "inference", "encode"):
            assert scrape("request_phase_seconds_count", message="submit_features", phase=phase) == 4
        assert scrape("request_phase_seconds_bucket", message="request_queries", phase="inference", le="+Inf") == 6
        parts_s = scrape("request_phase_seconds_sum", message="request_queries")
        assert 0.0 < parts_s < scrape("request_seconds_sum", message="request_queries")
        assert scrape("message_bots_sum", message="submit_features") == 4 * N
        assert scrape("message_bots_bucket", message="submit_features", le="2") == 0
        assert scrape("actions_total", bundle="tiny", reason="learned") == 4 * N
        assert scrape("actions_total", reason="non_finite_step_safe_action") == 0
        assert scrape("queries_total", reason="learned") == 6 * N
        assert scrape("deadlines_missed_total", outcome="late") == 0
        assert scrape("breaker_opened_total", bundle="tiny") == 0
        assert scrape("batch_connections_count", bundle="tiny") == 0
        assert scrape("refused_total", transport=door, code="NO_BOT") == 1
        assert scrape("skipped_frames_total") == N * (3 + 1)
        assert scrape("abandoned_queries_total") == N
        assert (scrape("bots"), scrape("bots_limit")) == (N, 8)
        assert (scrape("connections"), scrape("connections_limit"), scrape("bundle_connections")) == (1, 5, 1)
        sockets = {s.labels["transport"]: s.value for s in scrape.samples if s.name == "bot_runtime_sockets"}
        assert sockets.pop("http") >= 1  # that of the scrape
        assert sockets == ({} if door == "http" else {door: 1})
        assert (scrape("queue_length"), scrape("queue_limit"), scrape("ready")) == (0, 64, 1)
        assert scrape("bundle_info", bundle="tiny", method="bdt", precision="fp32") == 1
    assert {"process_resident_memory_bytes", "process_open_fds", "process_cpu_seconds"} <= set(scrape.families)


def test_budgets_and_measured_costs(server: Served) -> None:
    with BotClient(server.addresses["unix"]) as client:
        client.hello()
        bots = client.start(N, budgets_us=[1e6] * N)
        predicted_us, measured_us, allowed_us = 0.0, 0.0, 10.0
        for frame in range(20):
            queries = client.query(bots, frame, free_numbers(TABLE, N, frame), frame_budget_us=allowed_us)
            predicted_us += queries.cost_us.sum()
            acquire_us = 25.0 if queries.queries.any() else None
            measured_us += acquire_us or 0.0
            client.act(bots, frame, queries.queries, costly_numbers(TABLE, N, frame), acquire_us=acquire_us)
        scrape = Scrape(server)
    n = measured_us / 25.0
    assert n >= 3
    assert scrape("query_cost_seconds_total") == pytest.approx(predicted_us / 1e6)
    assert scrape("budget_allowed_seconds_total") == pytest.approx(20 * allowed_us / 1e6)
    assert scrape("acquire_measured_seconds_total") == pytest.approx(measured_us / 1e6)
    assert scrape("acquire_predicted_seconds_total") == pytest.approx(predicted_us / 1e6)
    assert scrape("acquire_error_seconds_total") >= (measured_us - predicted_us) / 1e6 - 1e-12
    assert scrape("frames_measured_total") == scrape("frames_over_budget_total") == n
    assert 0 < scrape("frames_over_predicted_total") <= n


def test_nothing_secret_and_every_name_by_the_conventions(server: Served) -> None:
    with BotClient(server.addresses["tcp"]) as client:
        welcome = client.hello()
        play(client, TABLE, client.start(1), range(2))
        scrape = Scrape(server)
    assert not any(welcome.connection in json.dumps(sample.labels) for sample in scrape.samples)
    for family in scrape.families.values():
        if not family.name.startswith(("bot_runtime_", "process_")):
            pytest.fail(family.name)
        assert family.documentation
        assert family.type in ("counter", "gauge", "histogram"), family
        assert not family.name.endswith(("_us", "_ms", "_total"))


def test_metrics_need_the_token(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", token="s3cret") as guarded:
        for headers in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": "s3cret"}):
            refused = http_request(guarded.addresses["http"], "GET", "/metrics", headers=headers)
            assert (refused.status, json.loads(refused.body)["code"]) == (401, "UNAUTHORIZED")
        scrape = Scrape(guarded, Authorization="Bearer s3cret")
        assert (scrape("bots"), scrape("connections")) == (0, 0)
        assert not any("s3cret" in str(sample) for sample in scrape.samples)
        for path in ("/healthz", "/readyz"):
            assert http_request(guarded.addresses["http"], "HEAD", path).status == 200
            assert http_request(guarded.addresses["http"], "GET", path).status == 200


def test_what_a_door_refuses_is_counted_too(bundle: Path, tmp_path: Path) -> None:
    with serve(bundle, tmp_path / "s", max_connections=1, token="s3cret") as server:
        with RawStream(server.addresses["tcp"]) as first, RawStream(server.addresses["unix"]) as second:
            assert second.frame(VECTORS["hello"].body)["code"] == "TOO_MANY_CONNECTIONS"
            first.socket.sendall(b"\x7f\xff\xff\xff")
            assert first.reply()["code"] == "TOO_LARGE"
        http = server.addresses["http"]
        assert http_request(http, "POST", "/v1/query", b"x", {"Content-Type": "text/plain"}).status == 415
        assert http_request(http, "GET", "/v1/costs").status == 401
        assert http_request(http, "GET", "/v1/nothing").status == 404
        assert http_request(http, "DELETE", "/healthz").status == 405
        operator = http_request(http, "POST", "/v1/bundles/tiny/activate", b"{}", {"Content-Type": "application/json"})
        assert operator.status == 401
        assert http_request(http, "POST", "/v1/connections", b"{", {"Content-Type": "application/json"}).status == 400
        scrape = Scrape(server, Authorization="Bearer s3cret")
    refused = {(s.labels["transport"], s.labels["code"]): s.value for s in scrape.samples if "refused" in s.name}
    assert refused == {
        ("unix", "TOO_MANY_CONNECTIONS"): 1,
        ("tcp", "TOO_LARGE"): 1,
        ("http", "UNSUPPORTED_MEDIA_TYPE"): 1,
        ("http", "UNAUTHORIZED"): 2,
        ("http", "NO_ROUTE"): 1,
        ("http", "METHOD_NOT_ALLOWED"): 1,
        ("http", "BAD_JSON"): 1,
    }


def test_versions_are_told_apart_and_one_in_memory_twice_is_summed(bundle: Path) -> None:
    """While versions are exchanged, connections may hold one that was loaded before it was loaded again."""
    loaded = Bundle.load(bundle)
    servings = [Serving(loaded, max_bots=4, version=version) for version in (1, 2, 2, None)]
    for count, serving in enumerate(servings, start=1):
        serving.bots.start(count)
    samples = [sample for family in families.bundles(servings) for sample in family.samples]
    keys = [(sample.name, *sorted(sample.labels.items())) for sample in samples]
    assert len(keys) == len(set(keys))
    bots = {sample.labels["version"]: sample.value for sample in samples if sample.name == "bot_runtime_bots"}
    assert bots == {"1": 1, "2": 2 + 3, servings[0].sha256[:12]: 4}
