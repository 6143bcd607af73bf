from __future__ import annotations

import socket
from pathlib import Path

import pytest

from server.listening import SEND_BYTES, listen_tcp, listen_unix


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"])
def test_listening_sockets_say_that_they_are_tcp(host: str) -> None:
    """asyncio turns Nagle's algorithm off only for sockets accepted from such."""
    with listen_tcp(host, 0) as listening:
        assert listening.proto == socket.IPPROTO_TCP


def test_what_a_client_does_not_take_is_bounded_in_the_system_too() -> None:
    with listen_tcp("127.0.0.1", 0) as listening, socket.create_connection(listening.getsockname()):
        listening.setblocking(True)
        accepted, _ = listening.accept()
        with accepted:
            assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 2 * SEND_BYTES  # Linux doubles it


def test_a_unix_socket_takes_the_place_of_one_that_a_dead_server_left(tmp_path: Path) -> None:
    path = tmp_path / "bots.sock"
    listen_unix(path).close()  # which leaves its name
    with listen_unix(path), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(path))


def test_a_unix_socket_takes_no_other_files_place(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("mine")
    with pytest.raises(OSError, match="in use"):
        listen_unix(path)
    assert path.read_text() == "mine"
