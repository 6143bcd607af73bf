"""Which transport a URL opens, and what it needs."""

from __future__ import annotations

import sys

import pytest

from protocol.client import BotClient
from protocol.transport import HttpTransport, StreamTransport, open_transport
from protocol.websocket import WebSocketTransport


@pytest.mark.parametrize(
    ("url", "kind"),
    [
        ("http://127.0.0.1:1", HttpTransport),
        ("tcp://127.0.0.1:1/", StreamTransport),
        ("unix:///tmp/s", StreamTransport),
        ("ws://127.0.0.1:1", WebSocketTransport),
        ("ws://127.0.0.1:1/v1/socket", WebSocketTransport),
    ],
)
def test_the_scheme_chooses(url: str, kind: type) -> None:
    assert isinstance(open_transport(url, 1.0), kind)


@pytest.mark.parametrize("url", ["ws://127.0.0.1", "ws://127.0.0.1:1/v1/query", "wss:///x:1", "x", "unix://a/b"])
def test_other_urls_are_refused(url: str) -> None:
    with pytest.raises(ValueError, match="none of"):
        BotClient(url)


def test_without_the_package_web_sockets_say_what_they_need(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "protocol.websocket")
    monkeypatch.setitem(sys.modules, "websockets.client", None)
    with pytest.raises(ImportError, match="websockets"):
        BotClient("ws://127.0.0.1:1")
    BotClient("tcp://127.0.0.1:1")
