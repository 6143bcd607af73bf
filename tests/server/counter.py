"""A desk on real bots whose requests take as long as the tests say, and where each was answered."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path

import msgpack
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.work import Steps
from protocol.codec import Format
from server import desk as module
from server.answer import Answer, Arrival, steps
from server.connections import Connections
from server.desk import Desk
from server.handlers import Handlers
from server.pace import Pace
from server.serving import Serving
from server.servings import Servings
from server.worker import Worker
from tests.protocol.golden import TABLE
from tests.server.serving import free_numbers

__all__ = ["Counter", "run_at_desk"]

BOUND_US = 500.0


class Counter:
    """A desk's requests one after the other, each said to take `us`, and where each was answered."""

    def __init__(self, bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        servings = Servings(max_bots=8)
        self.us, self.now_ns, self._frame = 10.0, 0, 0
        servings.activate(self.serving(bundle))
        self.worker = Worker(max_queue=4)
        self.threads: list[int] = []
        monkeypatch.setattr(module, "steps", self._steps)
        handlers = Handlers(servings, Connections(4, 60.0), None)
        self.desk = Desk(handlers, self.worker, inline_us=BOUND_US, clock=self._clock, worker_clock=self._clock)
        self.connection: str | None = None

    def _clock(self) -> int:
        return self.now_ns

    def serving(self, bundle: Path) -> Serving:
        """Of a bundle, by the clock of this desk."""
        serving = Serving(Bundle.load(bundle), max_bots=8)
        serving.pace = Pace(self._clock)
        return serving

    async def ask(self, message: dict[str, object]) -> tuple[dict[str, object], bool]:
        """The reply, and whether it was given on the event loop."""
        answered = self.put(message)
        answered = answered if isinstance(answered, Answer) else await answered
        return msgpack.unpackb(answered.body), self.threads[-1] == threading.get_ident()

    def put(self, message: dict[str, object]) -> Answer | asyncio.Future[Answer]:
        arrival = Arrival("tcp", self.now_ns)
        return self.desk.ask(msgpack.packb(message), Format.MSGPACK, self.connection, arrival)

    async def start(self, count: int, bundle: str | None = None) -> list[int]:
        """Bots of a new connection, which is from now on the one that asks."""
        self.connection = None
        welcome, _ = await self.ask({"type": "hello", "bundle": bundle})
        self.connection = str(welcome["connection"])
        started, _ = await self.ask({"type": "start_bots", "count": count})
        return list(started["bots"])

    async def query(self, bots: list[int]) -> bool:
        """Whether the next frame's query of these bots was answered on the event loop."""
        reply, inline = await self.ask(self.request(bots))
        assert reply["type"] == "queries", reply
        self.queries = reply["queries"]
        return inline

    async def look_again(self) -> None:
        """The event loop looks at its sockets once more, and nothing waits."""
        for _ in range(4):
            await asyncio.sleep(0)

    def request(self, bots: list[int], deadline_us: float | None = None) -> dict[str, object]:
        self._frame += 1
        free = free_numbers(TABLE, len(bots), self._frame).tobytes()
        head = {"type": "request_queries", "frame": self._frame, "bots": bots, "deadline_us": deadline_us}
        return {**head, "free": free}

    def features(self, bots: list[int], deadline_us: float | None = None) -> dict[str, object]:
        """The answer to their last query: all failed."""
        head = {"type": "submit_features", "frame": self._frame, "bots": bots, "deadline_us": deadline_us}
        asked = self.queries
        return {**head, "acquired": bytes(len(asked)), "values": b"", "failed": asked}

    def advance_us(self, us: float) -> None:
        self.now_ns += int(us * 1e3)

    def _steps(self, *arguments: object, **how: object) -> Steps[Answer]:
        self.threads.append(threading.get_ident())
        self.now_ns += int(self.us * 1e3)
        return (yield from steps(*arguments, **how))


def run_at_desk(bundle: Path, monkeypatch: pytest.MonkeyPatch, test: Callable[[Counter], object]) -> None:
    """Run a test that is a coroutine of the counter."""

    async def main() -> None:
        counter = Counter(bundle, monkeypatch)
        try:
            await test(counter)
        finally:
            counter.worker.close()

    asyncio.run(main())
