"""docker/prometheus and docker/grafana: whatever they ask for is what a real server's /metrics says."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from protocol.client import BotClient
from protocol.errors import NoBot
from tests.bundles import make_bundle
from tests.server.serving import costly_numbers, free_numbers, serve
from tests.server.test_metrics import Scrape

ROOT = Path(__file__).resolve().parent.parent
PROMETHEUS, GRAFANA = ROOT / "docker" / "prometheus", ROOT / "docker" / "grafana"
DASHBOARD = json.loads((GRAFANA / "dashboards" / "bots.json").read_text())
SELECTOR = re.compile(r"\b((?:bot_runtime|process)_\w+)(?:\{(.*?)\})?")
ADDED = {"instance", "job"}  # by Prometheus itself


def parsed(path: Path) -> Any:
    return pytest.importorskip("yaml").safe_load(path.read_text())


def expressions() -> list[str]:
    """Every PromQL expression of the dashboard and the rules."""
    rules = [rule for group in parsed(PROMETHEUS / "rules.yml")["groups"] for rule in group["rules"]]
    targets = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]
    return targets + [rule["expr"] for rule in rules]


@pytest.fixture(scope="module")
def scraped(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """The labels of each sample of a server that was used by every door and refused something."""
    folder = tmp_path_factory.mktemp("observed")
    with serve(make_bundle(folder / "tiny"), folder / "s") as served, BotClient(served.addresses["tcp"]) as client:
        table = client.hello().features
        bots = client.start(2)
        queries = client.query(bots, 0, free_numbers(table, 2, 0))
        client.act(bots, 0, queries.queries, costly_numbers(table, 2, 0), acquire_us=5.0)
        with BotClient(served.addresses["http"]) as other:
            other.hello()
            with pytest.raises(NoBot):
                other.query(bots, 1, free_numbers(table, 2, 1))
        samples = Scrape(served).samples
    labels: dict[str, set[str]] = {}
    for sample in samples:
        labels.setdefault(sample.name, set()).update(sample.labels)
    return labels


def test_every_metric_and_label_that_is_asked_for_exists(scraped: dict[str, set[str]]) -> None:
    asked = set()
    for expression in expressions():
        for name, matchers in SELECTOR.findall(expression):
            assert name in scraped, expression
            asked.add(name)
            given = set(re.findall(r"(\w+)\s*(?:=~|!~|!=|=)", matchers))
            assert given <= scraped[name] | ADDED, expression
        for by in re.findall(r"\bby \((.*?)\)", expression):
            known = set().union(*(scraped[name] for name, _ in SELECTOR.findall(expression))) | ADDED
            assert set(by.split(", ")) <= known, expression
    assert len(asked) > 20


def test_the_dashboard_shows_what_it_should() -> None:
    for variable in DASHBOARD["templating"]["list"]:
        assert re.match(r"label_values\(bot_runtime_\w+, \w+\)", variable["query"]["query"])
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(ids) == len(set(ids))
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        assert panel["description"]
        assert panel["datasource"]["uid"] == parsed_datasource()["uid"]


def parsed_datasource() -> dict[str, Any]:
    (source,) = parsed(GRAFANA / "provisioning" / "datasources" / "prometheus.yml")["datasources"]
    return source


def test_compose_starts_them_only_when_asked_and_mounts_what_is_there() -> None:
    services = parsed(ROOT / "compose.yaml")["services"]
    for name in ("prometheus", "grafana"):
        assert services[name]["profiles"] == ["observability"]
        assert all(port.startswith("127.0.0.1:") for port in services[name]["ports"])
        for volume in services[name]["volumes"]:
            assert (ROOT / volume.partition(":")[0]).is_dir(), volume
            assert volume.endswith(":ro")
    (job,) = parsed(PROMETHEUS / "prometheus.yml")["scrape_configs"]
    host, _, port = job["static_configs"][0]["targets"][0].partition(":")
    command = services[host]["command"]
    assert command[command.index("--port") + 1] == port
    (provider,) = parsed(GRAFANA / "provisioning" / "dashboards" / "bots.yml")["providers"]
    assert any(f":{provider['options']['path']}:" in volume for volume in services["grafana"]["volumes"])
    assert parsed_datasource()["url"] == "http://prometheus:9090"


def test_prometheus_takes_the_configuration() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed: Debian's package prometheus has it")
    checked = subprocess.run(
        [promtool, "check", "config", str(PROMETHEUS / "prometheus.yml")], capture_output=True, text=True, check=False
    )
    assert checked.returncode == 0, checked.stderr


def test_the_reference_lists_every_metric_and_no_other(scraped: dict[str, set[str]]) -> None:
    text = (ROOT / "docs" / "operations.md").read_text()
    table = text[text.index("| metric | labels |") : text.index("Counting takes")]
    documented = {name for row in table.splitlines() for name in re.findall(r"`((?:bot_runtime)_\w+)`", row)}
    counted = {re.sub(r"_(bucket|count|sum)$", "", name) for name in scraped if name.startswith("bot_runtime_")}
    assert documented == counted
