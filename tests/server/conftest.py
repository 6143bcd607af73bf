from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from bot_runtime.bundle import Bundle
from protocol.client import BotClient, Welcome
from server.serving import Serving
from tests.bundles import make_bundle
from tests.protocol.golden import TABLE, WELCOME
from tests.server.serving import Served, serve


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny bundle with the golden vectors' features, so that golden frames can be sent to a real server."""
    return make_bundle(tmp_path_factory.mktemp("bundle"), features=TABLE, action=WELCOME.action, budget=0.6)


@pytest.fixture(scope="session")
def serving(bundle: Path) -> Serving:
    """That bundle in memory, for tests that start no bots."""
    return Serving(Bundle.load(bundle), max_bots=1)


@pytest.fixture(scope="session")
def served(bundle: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server for all tests that leave nothing behind in it."""
    with serve(bundle, tmp_path_factory.mktemp("socket") / "s") as running:
        yield running


@pytest.fixture(params=["http", "tcp", "unix", "ws"])
def client(request: pytest.FixtureRequest, served: Served) -> Iterator[BotClient]:
    """A client that has said hello, by each door."""
    with BotClient(served.addresses[request.param]) as connected:
        connected.hello()
        yield connected


@pytest.fixture
def welcome(client: BotClient) -> Welcome:
    return client.welcome
