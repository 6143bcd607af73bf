"""One thread for the work that the event loop must not wait for.

This module knows nothing about what the work is. Whatever touches bots runs here, one job at a time, or on the event
loop while `is_idle`: never both, so nothing there needs a lock.
"""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

from protocol.errors import NotReady
from server.logs import logger

__all__ = ["Worker"]

T = TypeVar("T")
_log = logger(__name__)


class Worker:
    """A thread and its bounded queue. All but `busy_s` and the thread itself is for the event loop's thread only.

    `clock` counts seconds.
    """

    def __init__(self, max_queue: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.max_queue = max_queue
        self._clock = clock
        self._busy_since_s: float | None = None
        self._taken = 0  # jobs that were put into the queue: the event loop alone counts them
        self._done = 0  # jobs that have ended: the thread alone counts them
        self._expected_us: deque[float] = deque()  # of what runs or waits, after what has ended lately
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="inference", daemon=True)
        self._thread.start()

    @property
    def is_idle(self) -> bool:
        """Whether nothing runs or waits here: until the next `run` or `post` the event loop has the bots to itself."""
        return self._taken == self._done

    @property
    def n_waiting(self) -> int:
        """Jobs that wait here, with the one that runs."""
        return self._taken - self._done

    def busy_s(self) -> float:
        """How long ago the job began that runs now, in s; 0 where none does. From any thread."""
        since_s = self._busy_since_s
        return 0.0 if since_s is None else self._clock() - since_s

    @property
    def backlog_us(self) -> float:
        """How long it will take for all that runs or waits here to be done, by what was expected of it."""
        self._forget_done()
        if not self._expected_us:
            return 0.0
        return sum(self._expected_us) - min(1e6 * self.busy_s(), self._expected_us[0])

    def run(self, job: Callable[[], T], expected_us: float = 0.0) -> asyncio.Future[T]:
        """The job's result to be, or what it raises. Raises NotReady at once when too many jobs wait already.

        `expected_us` is what it will take, if that is known.
        """
        if self.n_waiting >= self.max_queue:
            raise NotReady(f"{self.n_waiting} requests are waiting already", retry_after_s=0.1)
        outcome: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        self._put(_Job(job, outcome), expected_us)
        return outcome

    def post(self, job: Callable[[], object]) -> None:
        """Do this too, in its turn, without anybody waiting for it: never refused, so for ending things only."""
        self._put(_Job(job, None), 0.0)

    def close(self, timeout_s: float | None = None) -> None:
        """Finish what was queued and end the thread; one that is stuck for longer is left to die with the process."""
        self._jobs.put(None)
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            _log.error("a job did not end within %g s", timeout_s)

    def _put(self, job: _Job, expected_us: float) -> None:
        self._forget_done()
        self._expected_us.append(expected_us)
        self._taken += 1
        self._jobs.put(job)

    def _forget_done(self) -> None:
        while len(self._expected_us) > self.n_waiting:
            self._expected_us.popleft()

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._busy_since_s = self._clock()
            try:
                result, error = job.call(), None
            except Exception as raised:
                result, error = None, raised
            self._busy_since_s = None
            self._done += 1  # before anyone is told: whoever is may put the next job at once
            job.tell(result, error)


class _Job:
    """A call, and the future of whoever waits for its outcome, if anybody does."""

    def __init__(self, call: Callable[[], object], outcome: asyncio.Future[Any] | None) -> None:
        self.call = call
        self._outcome = outcome

    def tell(self, result: object, error: Exception | None) -> None:
        """Hand the outcome to the event loop; what nobody waits for is logged where it failed."""
        if self._outcome is not None:
            self._outcome.get_loop().call_soon_threadsafe(self._settle, self._outcome, result, error)
        elif error is not None:
            _log.error("a job failed", exc_info=error)

    @staticmethod
    def _settle(outcome: asyncio.Future[Any], result: object, error: Exception | None) -> None:
        if outcome.done():
            return  # nobody waits any more: the client went away
        if error is None:
            outcome.set_result(result)
        else:
            outcome.set_exception(error)
