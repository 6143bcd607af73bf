"""A server that answers what it is told to, well-formed or not, and keeps what it was asked."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NamedTuple

__all__ = ["Conversation", "FakeServer", "answering"]

_PATIENCE_S = 20


class Conversation(NamedTuple):
    """What one client that connects is sent: `answers`, each after a frame of its own, in `drops` bytes at a time."""

    answers: Sequence[bytes]
    closes: bool = False
    drops: int | None = None


class FakeServer(NamedTuple):
    port: int
    asked: list[bytes]


@contextmanager
def answering(conversations: Sequence[Conversation]) -> Iterator[FakeServer]:
    """Hold these conversations on loopback, one after the other; unless it closes, each ends when the client leaves."""
    asked: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(_PATIENCE_S)

        def talk() -> None:
            with suppress(OSError):
                for conversation in conversations:
                    with listener.accept()[0] as client:
                        client.settimeout(_PATIENCE_S)
                        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        _hold(conversation, client, asked)

        thread = threading.Thread(target=talk)
        thread.start()
        try:
            yield FakeServer(listener.getsockname()[1], asked)
        finally:
            listener.close()
            thread.join()


def _hold(conversation: Conversation, client: socket.socket, asked: list[bytes]) -> None:
    with suppress(ConnectionError):
        for answer in conversation.answers:
            (size,) = struct.unpack(">I", _exactly(client, 4))
            asked.append(_exactly(client, size))
            step = conversation.drops or max(len(answer), 1)
            for start in range(0, len(answer), step):
                client.sendall(answer[start : start + step])
        while not conversation.closes and client.recv(65536):
            pass


def _exactly(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        part = client.recv(size - len(data))
        if not part:
            raise ConnectionResetError
        data += part
    return data
