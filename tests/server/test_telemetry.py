"""The exporter, against a collector on loopback: what it is sent is what /metrics says."""

from __future__ import annotations

import gzip
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from protocol.client import BotClient
from server.recorder import NS_BOUNDS
from tests.protocol.golden import TABLE
from tests.server.serving import play, serve
from tests.server.test_metrics import Scrape

service = pytest.importorskip("opentelemetry.proto.collector.metrics.v1.metrics_service_pb2")
WAIT_S = 30.0


def labels(point: Any) -> dict[str, str]:
    return {each.key: each.value.string_value for each in point.attributes}


class Collector:
    """Keeps what it was sent last."""

    def __init__(self) -> None:
        received: queue.Queue[bytes] = queue.Queue()

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                received.put(gzip.decompress(body) if self.headers.get("content-encoding") == "gzip" else body)
                self.send_response(200)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self.received, self.server = received, HTTPServer(("127.0.0.1", 0), Handler)
        self.endpoint = f"http://127.0.0.1:{self.server.server_port}/v1/metrics"

    def next(self) -> dict[str, Any]:
        """What is sent after this call, by name."""
        while not self.received.empty():
            self.received.get()
        self.received.get(timeout=WAIT_S)  # this one may have been begun before
        request = service.ExportMetricsServiceRequest.FromString(self.received.get(timeout=WAIT_S))
        (resource,) = request.resource_metrics
        return {metric.name: metric for scope in resource.scope_metrics for metric in scope.metrics}


@pytest.fixture
def collector() -> Iterator[Collector]:
    collector = Collector()
    thread = threading.Thread(target=collector.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield collector
    finally:
        collector.server.shutdown()
        thread.join()
        collector.server.server_close()


def test_a_collector_gets_what_prometheus_gets(bundle: Path, tmp_path: Path, collector: Collector) -> None:
    exporter = {"otlp_endpoint": collector.endpoint, "otlp_every_s": 0.05}
    with serve(bundle, tmp_path / "s", **exporter) as served, BotClient(served.addresses["tcp"]) as client:
        client.hello()
        play(client, TABLE, client.start(3), range(5))
        sent, scrape = collector.next(), Scrape(served)
    actions = {labels(point)["reason"]: point.as_double for point in sent["bot_runtime_actions"].sum.data_points}
    assert (actions["learned"], sent["bot_runtime_actions"].sum.is_monotonic) == (15.0, True)
    assert sent["bot_runtime_bots"].gauge.data_points[0].as_double == 3.0
    times = sent["bot_runtime_request_seconds"]
    assert times.unit == "s"
    for point in times.histogram.data_points:
        of = labels(point)
        assert list(point.explicit_bounds) == pytest.approx([bound / 1e9 for bound in NS_BOUNDS], rel=1e-5)
        assert sum(point.bucket_counts) == point.count == scrape("request_seconds_count", **of)
        assert point.sum == pytest.approx(scrape("request_seconds_sum", **of))
        assert point.bucket_counts[0] == scrape("request_seconds_bucket", **of, le="1e-06")
        assert not point.HasField("min")
    assert len(times.histogram.data_points) == 4  # hello, start_bots, request_queries, submit_features
    assert "process_resident_memory_bytes" in sent
    assert not [thread for thread in threading.enumerate() if thread.name == "telemetry"]


def test_a_collector_that_is_gone_harms_nobody(bundle: Path, tmp_path: Path) -> None:
    exporter = {"otlp_endpoint": "http://127.0.0.1:9/v1/metrics", "otlp_every_s": 0.01}
    with serve(bundle, tmp_path / "s", **exporter) as served, BotClient(served.addresses["tcp"]) as client:
        client.hello()
        play(client, TABLE, client.start(3), range(20))
        assert Scrape(served)("actions_total", reason="learned") == 60


def test_without_the_extra_it_says_what_is_missing(bundle: Path) -> None:
    program = (
        "import sys\n"
        "sys.modules['opentelemetry.sdk'] = None\n"
        f"sys.argv = ['server', '--bundle', {str(bundle)!r}, '--port', '0', '--otlp-endpoint', 'http://x/v1/metrics']\n"
        "from server.__main__ import main\n"
        "main()\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 2
    assert "extra `telemetry`" in ended.stderr
    assert "Traceback" not in ended.stderr
