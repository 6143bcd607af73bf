"""How long an event loop stays awake, and that turns are the same over one that does."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from protocol.client import BotClient
from server.vigil import Vigil
from tests.protocol.golden import TABLE
from tests.server.serving import play, same, serve


class Clock:
    """A µs passes from each look to the next."""

    def __init__(self) -> None:
        self.looks = 0

    def __call__(self) -> int:
        self.looks += 1
        return 1000 * self.looks


@pytest.mark.parametrize(("spin_us", "looks"), [(0.0, 0), (20.0, 21)])
def test_it_is_awake_for_so_long_and_not_longer(spin_us: float, looks: int) -> None:
    async def main() -> int:
        clock = Clock()
        vigil = Vigil(spin_us, clock)
        for _ in range(2):  # it begins anew when it is over
            clock.looks = 0
            vigil.begin()
            for _ in range(100):
                await asyncio.sleep(0)
        return clock.looks

    assert asyncio.run(main()) == looks


def test_a_later_answer_prolongs_it_and_one_watch_is_enough() -> None:
    async def main() -> int:
        clock = Clock()
        vigil = Vigil(20.0, clock)
        for _ in range(10):
            vigil.begin()
            await asyncio.sleep(0)
        begun = clock.looks
        for _ in range(100):
            await asyncio.sleep(0)
        return clock.looks - begun

    assert asyncio.run(main()) <= 21


@pytest.mark.parametrize("door", ["http", "tcp", "unix", "ws"])
def test_turns_are_the_same_where_nobody_sleeps(bundle: Path, tmp_path: Path, door: str) -> None:
    played = []
    for spin_us in (0.0, 500.0):
        with (
            serve(bundle, tmp_path / f"{spin_us}", spin_us=spin_us) as served,
            BotClient(served.addresses[door], timeout_s=30.0, spin_us=spin_us) as client,
        ):
            client.hello()
            played.append(play(client, TABLE, client.start(2, seeds=[1, 2]), range(6)))
    assert same(*played)
