"""Sockets that stay awake for a moment, from a URL to the other end of the line."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from protocol.client import BotClient
from protocol.dial import MAX_SPIN_US, dial


@pytest.fixture
def listening(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as opened:
        opened.bind(str(tmp_path / "s"))
        opened.listen(1)
        yield opened


@pytest.mark.parametrize("spin_us", [0.0, 300.0, MAX_SPIN_US])
def test_what_comes_is_read_and_what_does_not_is_not_waited_for(listening: socket.socket, spin_us: float) -> None:
    opened = dial(listening.getsockname(), 0.05, None, spin_us)
    other, _ = listening.accept()
    with other:
        opened.sendall(b"there")
        assert other.recv(100) == b"there"
        other.sendall(b"and back")
        assert opened.recv(100) == b"and back"
        with pytest.raises(TimeoutError):
            opened.recv(100)
    assert opened.recv(100) == b""
    opened.close()


def test_whoever_spins_is_awake_when_it_comes(listening: socket.socket) -> None:
    opened = dial(listening.getsockname(), 0.0001, None, 30e6)  # asleep it would give up long before
    other, _ = listening.accept()
    with other:
        threading.Timer(0.05, other.sendall, (b"x",)).start()
        assert opened.recv(100) == b"x"
    opened.close()


@pytest.mark.parametrize("spin_us", [-1.0, MAX_SPIN_US + 1.0, float("nan")])
def test_other_spins_are_refused(spin_us: float) -> None:
    with pytest.raises(ValueError, match="spin_us"):
        BotClient("tcp://127.0.0.1:1", spin_us=spin_us)
