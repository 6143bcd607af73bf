from __future__ import annotations

import asyncio
import threading

import pytest

from protocol.errors import NotReady
from server.worker import Worker


def test_jobs_run_in_order_on_one_other_thread() -> None:
    async def main() -> None:
        worker = Worker(max_queue=10)
        try:
            ran: list[int] = []
            threads = await asyncio.gather(
                *(worker.run(lambda i=i: (ran.append(i), threading.get_ident())[1]) for i in range(9))
            )
            assert ran == list(range(9))
            assert len(set(threads)) == 1
            assert threads[0] != threading.get_ident()
        finally:
            worker.close()

    asyncio.run(main())


def test_what_a_job_raises_comes_back_and_the_worker_goes_on() -> None:
    async def main() -> None:
        worker = Worker(max_queue=1)
        try:
            with pytest.raises(ZeroDivisionError):
                await worker.run(lambda: 1 // 0)
            assert await worker.run(lambda: 7) == 7
        finally:
            worker.close()

    asyncio.run(main())


def test_the_loop_goes_on_and_a_full_queue_refuses_at_once() -> None:
    async def main() -> None:
        worker, release = Worker(max_queue=2), threading.Event()
        try:
            slow = asyncio.ensure_future(worker.run(release.wait))
            waiting = asyncio.ensure_future(worker.run(lambda: "done"))
            await asyncio.sleep(0)
            with pytest.raises(NotReady) as refusal:
                await worker.run(lambda: "never")
            assert refusal.value.retry_after_s
            release.set()
            assert (await slow, await waiting) == (True, "done")
            assert await worker.run(lambda: "again") == "again"
        finally:
            release.set()
            worker.close()

    asyncio.run(main())


def test_a_job_that_nobody_waits_for_any_more_harms_nothing() -> None:
    async def main() -> None:
        worker, release = Worker(max_queue=2), threading.Event()
        try:
            left = asyncio.ensure_future(worker.run(release.wait))
            await asyncio.sleep(0)
            left.cancel()
            await asyncio.gather(left, return_exceptions=True)
            release.set()
            assert await worker.run(lambda: 7) == 7
        finally:
            release.set()
            worker.close()

    asyncio.run(main())


def test_closing_finishes_what_was_posted() -> None:
    worker, done = Worker(max_queue=1), []
    worker.post(lambda: done.append(1))
    worker.post(lambda: done.append(2))
    worker.close()
    assert done == [1, 2]


def test_a_job_that_never_ends_does_not_keep_the_server_from_ending(caplog: pytest.LogCaptureFixture) -> None:
    worker, reached, release = Worker(max_queue=1), threading.Event(), threading.Event()
    worker.post(lambda: (reached.set(), release.wait()))
    reached.wait()
    worker.close(0.01)
    assert "did not end" in caplog.text
    release.set()
    worker.close()


def test_the_backlog_is_what_was_expected_of_all_that_is_not_done() -> None:
    async def main() -> None:
        now = [0.0]
        worker, reached, release = Worker(4, lambda: now[0]), threading.Event(), threading.Event()
        try:
            assert worker.backlog_us == 0.0
            jobs = [worker.run(lambda: (reached.set(), release.wait()), 1000.0), worker.run(lambda: None, 500.0)]
            await asyncio.to_thread(reached.wait)
            assert worker.backlog_us == 1500.0
            now[0] = 0.0004
            assert worker.backlog_us == pytest.approx(1100.0)
            now[0] = 9.0  # what takes longer than expected may end at any time
            assert worker.backlog_us == 500.0
            release.set()
            await asyncio.gather(*jobs)
            assert worker.backlog_us == 0.0
        finally:
            release.set()
            worker.close()

    asyncio.run(main())


def test_what_ended_jobs_were_expected_to_take_is_forgotten_though_nobody_asks_for_the_backlog() -> None:
    """A number a job, kept for good, is a leak that only hours show."""

    async def main() -> None:
        worker = Worker(max_queue=1)
        try:
            for _ in range(100):
                await worker.run(int, 5.0)
            assert len(worker._expected_us) == 1
        finally:
            worker.close()

    asyncio.run(main())
