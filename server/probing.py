"""Probing: bundles whose breaker is open are tried again, away from the thread that serves.

This module knows nothing about why a breaker opened or what happens to requests meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress

from server.servings import Servings

__all__ = ["probing"]

_LOOK_S = 0.05  # how often; how often a probe runs is the breaker's
_log = logging.getLogger(__name__)


@asynccontextmanager
async def probing(servings: Servings) -> AsyncIterator[None]:
    """Inside the `async with`, probe each bundle whose breaker says that a probe is due, one at a time."""
    with ThreadPoolExecutor(1, thread_name_prefix="probe") as thread:
        looking = asyncio.create_task(_look(servings, thread))
        try:
            yield
        finally:
            looking.cancel()
            with suppress(asyncio.CancelledError):
                await looking


async def _look(servings: Servings, thread: ThreadPoolExecutor) -> None:
    while True:
        await asyncio.sleep(_LOOK_S)
        for serving in servings:
            breaker = serving.bots.haste.breaker
            probe = breaker.due()
            if probe is None:
                continue
            try:
                took_us = await asyncio.get_running_loop().run_in_executor(thread, serving.bots.probe, probe)
            except Exception:  # whatever it is, the bundle does not work, and others want to be probed too
                _log.exception("a probe of %s failed", serving.name)
                took_us = float("inf")
            breaker.probed(took_us)
            state = "open" if breaker.is_open else "closed"
            _log.info("probe of %s: %.0f of %.0f us, breaker %s", serving.name, took_us, probe.allowed_us, state)
