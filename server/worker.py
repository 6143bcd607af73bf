"""One thread that does all the work, so that the event loop never waits for a model.

This module knows nothing about what the work is. Everything that touches bots runs here, one job at a time, so nothing
there needs a lock.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from protocol.errors import NotReady

__all__ = ["Worker"]

T = TypeVar("T")
_log = logging.getLogger(__name__)


class Worker:
    """A thread and its bounded queue. `run` and `post` are for the event loop's thread only."""

    def __init__(self, max_queue: int) -> None:
        self._max_queue = max_queue
        self._waiting = 0
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="inference", daemon=True)
        self._thread.start()

    async def run(self, job: Callable[[], T]) -> T:
        """The job's result, or what it raised. Raises NotReady at once when too many jobs wait already."""
        if self._waiting >= self._max_queue:
            raise NotReady(f"{self._waiting} requests are waiting already", retry_after_s=0.1)
        loop = asyncio.get_running_loop()
        outcome: asyncio.Future[T] = loop.create_future()
        self._waiting += 1
        try:
            self._jobs.put(_Call(job, loop, outcome))
            return await outcome
        finally:
            self._waiting -= 1

    def post(self, job: Callable[[], None]) -> None:
        """Do this too, in its turn, without anybody waiting for it: never refused, so for ending things only."""
        self._jobs.put(job)

    def close(self) -> None:
        """Finish what was queued and end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception:
                _log.exception("a job failed")


class _Call(Generic[T]):
    """A job whose outcome goes back to the event loop that waits for it."""

    def __init__(self, job: Callable[[], T], loop: asyncio.AbstractEventLoop, outcome: asyncio.Future[T]) -> None:
        self._job = job
        self._loop = loop
        self.outcome = outcome

    def __call__(self) -> None:
        try:
            result = self._job()
        except Exception as error:
            self._loop.call_soon_threadsafe(self._fail, error)
        else:
            self._loop.call_soon_threadsafe(self._succeed, result)

    def _succeed(self, result: T) -> None:
        if not self.outcome.done():  # nobody waits any more if the client went away
            self.outcome.set_result(result)

    def _fail(self, error: Exception) -> None:
        if not self.outcome.done():
            self.outcome.set_exception(error)
