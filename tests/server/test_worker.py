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
