"""Probing goes on whatever a probe does, for the bundle that fails and for others."""

from __future__ import annotations

import asyncio
import time

import pytest

from bot_runtime.breaker import Probe
from server.probing import probing
from server.serving import Serving
from server.servings import Servings

WAIT_S = 20.0


def test_a_probe_that_fails_is_not_the_last(serving: Serving, monkeypatch: pytest.MonkeyPatch) -> None:
    servings, failures = Servings(8), iter([MemoryError("none left"), RuntimeError("the graph"), None])
    servings.activate(serving)

    def probe(_: Probe) -> float:
        failure = next(failures)
        if failure is not None:
            raise failure
        return 1.0

    monkeypatch.setattr(serving.bots, "probe", probe)
    breaker = serving.bots.haste.breaker
    for _ in range(3):
        breaker.report("act", Probe(1, 100.0), overran=True)

    async def until_closed() -> None:
        give_up_s = time.monotonic() + WAIT_S
        async with probing(servings):
            while breaker.is_open and time.monotonic() < give_up_s:
                await asyncio.sleep(0.01)

    assert breaker.is_open
    asyncio.run(until_closed())
    assert not breaker.is_open
