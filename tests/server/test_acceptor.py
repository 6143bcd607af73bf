from __future__ import annotations

import asyncio
import errno
import socket
from typing import Any

import pytest
import uvloop

from server import acceptor
from server.acceptor import Acceptor
from server.listening import listen_tcp


class Greeter(asyncio.Protocol):
    """Says hello; remembers who came in which round of the event loop."""

    def __init__(self, arrived: list[int], rounds: list[int]) -> None:
        self._arrived, self._rounds = arrived, rounds

    def connection_made(self, transport: Any) -> None:
        self._arrived.append(self._rounds[0])
        transport.write(b"hello")
        transport.close()


def clients(listening: socket.socket, count: int) -> list[socket.socket]:
    """Connected as far as they know: nobody has accepted them yet."""
    return [socket.create_connection(listening.getsockname()) for _ in range(count)]


async def greetings(waiting: list[socket.socket]) -> list[bytes]:
    """What each reads until its end."""
    said = []
    for client in waiting:
        reader, writer = await asyncio.open_connection(sock=client)
        said.append(await reader.read())
        writer.close()
        await writer.wait_closed()
    return said


@pytest.fixture(params=[asyncio.run, uvloop.run])
def run(request: pytest.FixtureRequest) -> Any:
    return request.param


def test_many_that_wait_are_let_in_one_a_look(run: Any) -> None:
    async def main() -> None:
        arrived: list[int] = []
        rounds = [0]
        listening = listen_tcp("127.0.0.1", 0)
        waiting = clients(listening, 8)
        door = Acceptor(listening, lambda: Greeter(arrived, rounds))
        while len(arrived) < len(waiting):
            rounds[0] += 1
            await asyncio.sleep(0)
        assert await greetings(waiting) == [b"hello"] * len(waiting)
        assert len(set(arrived)) == len(arrived)  # no two in one round
        door.close()
        await door.wait_closed()

    run(main())


def test_after_closing_nobody_is_let_in_and_closing_again_does_nothing(run: Any) -> None:
    async def main() -> None:
        listening = listen_tcp("127.0.0.1", 0)
        address = listening.getsockname()
        door = Acceptor(listening, lambda: Greeter([], [0]))
        door.close()
        door.close()
        await door.wait_closed()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(address)

    run(main())


class Full(socket.socket):
    """A listening socket for whose clients the system has no descriptors left, for as often as `refusals` says."""

    refusals = 2

    def accept(self) -> Any:
        if self.refusals:
            self.refusals -= 1
            raise OSError(errno.EMFILE, "Too many open files")
        return super().accept()


def full() -> Full:
    listening = Full(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    listening.setblocking(False)
    return listening


def test_where_there_is_no_room_it_rests_and_tries_again(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptor, "_REST_S", 0.01)

    async def main() -> None:
        listening = full()
        waiting = clients(listening, 2)
        door = Acceptor(listening, lambda: Greeter([], [0]))
        assert await greetings(waiting) == [b"hello"] * 2
        assert listening.refusals == 0
        door.close()
        await door.wait_closed()

    run(main())


def test_it_can_be_closed_while_it_rests(run: Any) -> None:
    async def main() -> None:
        listening = full()
        waiting = clients(listening, 1)
        door = Acceptor(listening, lambda: Greeter([], [0]))
        while listening.refusals == Full.refusals:
            await asyncio.sleep(0)
        door.close()
        await door.wait_closed()
        with pytest.raises(ConnectionResetError):
            await greetings(waiting)

    run(main())
