"""A soak of seconds passes, and fails a server that keeps its replies; what the server holds is read from itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.soak import Soaked, State, state
from protocol.client import BotClient
from tests.bundles import make_bundle
from tests.server.serving import serve


@pytest.mark.parametrize(("control", "ends_with"), [((), 0), (("--leak",), 1)])
def test_a_leak_fails_the_soak(tmp_path: Path, control: tuple[str, ...], ends_with: int) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    # Half of the leak is within the warm-up: the replies of what is left are still some 10 MiB.
    options = ["--bundle", str(bundle), "--minutes", "0.06", "--warm-up", "0.5", "--most-growth-mib", "4", "--json"]
    command = [sys.executable, "-m", "benchmarks.soak", *options, *control]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=100)
    line = json.loads(done.stdout)
    assert (done.returncode, line["passed"], line["failed"]) == (ends_with, ends_with == 0, [])
    assert line["before"]["bots"] == line["after"]["bots"] == 0
    assert line["before"]["descriptors"] == line["after"]["descriptors"]
    assert line["done"]["turns"] > 0


def test_what_a_server_holds_is_read_from_it(tmp_path: Path) -> None:
    with (
        serve(make_bundle(tmp_path / "tiny"), tmp_path / "s") as served,
        BotClient(served.addresses["tcp"]) as client,
    ):
        client.hello()
        client.start(3)
        held = state(os.getpid(), served.addresses["http"])
    assert (held.bots, held.connections) == (3, 1)
    assert min(held.rss_mib, held.descriptors, held.threads) > 0


def test_what_passes() -> None:
    before = State(100.0, 17, 3, 0, 0)
    soaked = Soaked(1.0, 101.0, before, before._replace(rss_mib=101.0))
    assert soaked.passed(20.0)
    assert not soaked.passed(1.0)
    assert not replace(soaked, failed=["x"]).passed(20.0)
    for name in ("descriptors", "threads", "bots", "connections"):
        assert not replace(soaked, after=before._replace(**{name: 99})).passed(20.0)
