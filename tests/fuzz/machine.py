"""What engines may do to a server in memory, step by step, its replies compared with the model's.

This module knows nothing about how many runs there are. Requests are bytes, as they come to every door, and so are
replies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.fuzz.world import World
from tests.protocol.golden import TABLE

__all__ = ["ServerMachine"]

RECENT = 7
PLACES = st.integers(0, RECENT - 1)
WHICH = st.lists(PLACES, min_size=1, max_size=3)
STEPS = st.sampled_from([-1, 0, 0, 0, 1, 1, 1, 4])  # from the newest frame: back, again, on, a gap
CONTENTS = st.sampled_from([0, 0, 0, 1])
SPOILT = st.sampled_from([None] * 6 + ["BAD_SHAPE", "NON_FINITE", "OUT_OF_RANGE"])
RARELY = st.sampled_from([False, False, True])  # rules are drawn equally often, and these end things
BUDGETS = [0.0, 5.0, 1e6]
BY = st.sampled_from([0] * 9 + [1])  # the bots' own connection, or another


class ServerMachine(RuleBasedStateMachine):
    """Frames near the newest and two contents, so that retries, reuse and stale frames happen often."""

    def __init__(self, world: World) -> None:
        super().__init__()
        self.world, self.model, self.newest = world, world.model, 0
        self.owner: dict[int, str] = {}
        self.everyone: list[str] = []  # connections, those that have ended too

    def teardown(self) -> None:
        self.world.clear()

    @initialize(counts=st.lists(st.integers(1, 3), min_size=1, max_size=2), budget_us=st.sampled_from(BUDGETS))
    def begin_with(self, counts: list[int], budget_us: float) -> None:
        """Some connections have some bots."""
        for place, count in enumerate(counts):
            self.hello()
            self.start(place, count, place, budget_us)

    @rule()
    def hello(self) -> None:
        refused = self.model.may_open()
        reply = self.world.send(None, type="hello")
        if refused:
            assert reply["code"] in refused
            return
        assert reply["connection"] not in self.everyone
        self.model.open(reply["connection"])
        self.everyone.append(reply["connection"])

    @rule(which=PLACES, means_it=RARELY)
    def goodbye(self, which: int, means_it: bool) -> None:
        if not means_it:
            return
        name = _recent(self.everyone, which)
        refused = self.model.hear(name)
        reply = self.world.send(name, type="goodbye")
        assert reply.get("code") in (refused or {None})
        if not refused:
            self.model.end(name)

    @rule(seconds=st.sampled_from([1.0] * 6 + [6.0, 11.0]), swept=st.booleans())
    def wait(self, seconds: float, swept: bool) -> None:
        self.world.wait(seconds)
        if swept:
            self.world.handlers.end_silent()
            self.model.sweep()

    @rule(which=PLACES, count=st.integers(1, 3), seed=st.integers(0, 2**62), budget_us=st.sampled_from(BUDGETS))
    def start(self, which: int, count: int, seed: int, budget_us: float) -> None:
        name, seeds, budgets_us = _recent(self.everyone, which), [seed + n for n in range(count)], [budget_us] * count
        refused = self.model.hear(name) or self.model.may_start(count)
        reply = self.world.send(name, type="start_bots", count=count, seeds=seeds, budgets_us=budgets_us)
        if refused:
            assert reply["code"] in refused
            return
        assert not self.world.used.intersection(reply["bots"])
        self.world.used.update(reply["bots"])
        self.model.start(name, reply["bots"], seeds, budgets_us)
        self.owner.update(dict.fromkeys(reply["bots"], name))

    @rule(which=WHICH, by=BY, means_it=RARELY)
    def stop(self, which: list[int], by: int, means_it: bool) -> None:
        if not means_it:
            return
        named = self.named(which)
        name = self.speaker(named, by)
        refused = self.model.hear(name) or self.model.owned(name, named)
        reply = self.world.send(name, type="stop_bots", bots=named)
        if refused:
            assert reply["code"] in refused
        else:
            assert reply["count"] == len(named)
            self.model.stop(name, named)

    @rule(which=WHICH, by=BY, step=STEPS, content=CONTENTS)
    def ask_some(self, which: list[int], by: int, step: int, content: int) -> None:
        self.begin(self.named(which), by, self.at(step), content, None, False)

    @rule(which=PLACES, step=STEPS, content=CONTENTS)
    def play(self, which: int, step: int, content: int) -> None:
        """A frame as it should be."""
        self.turn(which, 0, abs(step), content, None, False, True)

    @rule(which=PLACES, by=BY, step=STEPS, content=CONTENTS, spoilt=SPOILT, taken=st.booleans(), ends=st.booleans())
    def turn(self, which: int, by: int, step: int, content: int, spoilt: str | None, taken: bool, ends: bool) -> None:
        """All bots of this bot's connection, in their order."""
        bot = _recent(list(self.owner), which)
        link, number = self.model.links.get(self.owner[bot]), self.at(step)
        named = sorted(link.bots) if link is not None and link.bots else [bot]
        self.begin(named, by, number, content, spoilt, taken)
        if ends:
            self.submit(named, by, number, content, None)

    @rule(which=PLACES, by=BY, content=CONTENTS, spoilt=SPOILT)
    def submit_last(self, which: int, by: int, content: int, spoilt: str | None) -> None:
        frame = self.model.last.get(_recent(list(self.owner), which))
        if frame is not None:
            self.submit(frame.bots, by, frame.number, content, spoilt)

    @rule(which=WHICH, by=BY, step=STEPS)
    def submit_some(self, which: list[int], by: int, step: int) -> None:
        self.submit(self.named(which), by, self.at(step), 0, None)

    def begin(self, named: list[int], by: int, number: int, content: int, spoilt: str | None, taken: bool) -> None:
        """Ask, or take a whole turn in which nothing was acquired."""
        model, name, rewards = self.model, self.speaker(named, by), [20.0 * content] * len(named)
        free = self.numbers(named, number, content, TABLE.free_range)
        refused = model.hear(name) or model.owned(name, named)
        refused = refused or ({"BAD_SHAPE"} if spoilt == "BAD_SHAPE" else model.may_begin(named, number, taken))
        refused = refused or ({spoilt} if spoilt else set())
        message: dict[str, Any] = {"frame": number, "bots": named, "free": _spoilt(free, spoilt), "rewards": rewards}
        if taken:
            none = bytes(len(named) * -(-TABLE.n_queries // 8))
            reply = self.world.send(name, type="take_turn", acquired=none, values=b"", **message)
        else:
            reply = self.world.send(name, type="request_queries", **message)
        told = None if refused else model.begun(named, number, (free.tobytes(), rewards))
        if not refused and told is None:
            play = model.take if taken else model.ask
            told = play(named, number, free, rewards, (free.tobytes(), rewards))
        self.compare(reply, refused or told)

    def submit(self, named: list[int], by: int, number: int, content: int, spoilt: str | None) -> None:
        """All that was asked for; without a query, nothing."""
        model, name = self.model, self.speaker(named, by)
        frame = model.last.get(named[0])
        asked = np.zeros((len(named), TABLE.n_queries), dtype=np.bool_)
        if frame is not None and len(frame.bots) == len(named):
            asked = frame.query_NM
        costly = self.numbers(named, number, content, TABLE.costly_range)
        values = costly[asked[:, TABLE.owner]]
        spoilt = spoilt if values.size else None
        refused = model.hear(name) or model.owned(name, named)
        refused = refused or ({"BAD_SHAPE"} if spoilt == "BAD_SHAPE" else model.may_submit(named, number))
        refused = refused or ({spoilt} if spoilt else set())
        message = {"frame": number, "bots": named, "values": _spoilt(values, spoilt)}
        acquired = np.packbits(asked, axis=1, bitorder="little").tobytes()
        reply = self.world.send(name, type="submit_features", acquired=acquired, **message)
        self.compare(reply, refused or model.submit(named, costly))

    def compare(self, reply: dict[str, Any], told: dict[str, Any] | set[str]) -> None:
        """The server's reply and the model's."""
        if isinstance(told, set):
            assert reply.get("code") in told, (reply, told)
        else:
            assert told.items() <= reply.items(), (reply, told)

    def speaker(self, named: list[int], by: int) -> str:
        """The connection of the first of these bots, or `by` others further on in the order in which they came."""
        return self.everyone[(self.everyone.index(self.owner[named[0]]) + by) % len(self.everyone)]

    def named(self, which: list[int]) -> list[int]:
        """These bots, each once, whether they are still there or not."""
        everyone = list(self.owner)
        return list(dict.fromkeys(_recent(everyone, place) for place in which))

    def at(self, step: int) -> int:
        """A frame's number."""
        number = max(0, self.newest + step)
        self.newest = max(self.newest, number)
        return number

    def numbers(self, named: list[int], number: int, content: int, limits: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Numbers [N, n] that depend on the frame, the content and the place alone."""
        low, high = (np.clip(limit, -3.0, 3.0) for limit in limits)
        random = np.random.default_rng([number, content])
        return random.uniform(low, high, (len(named), low.size)).astype(np.float32)

    @invariant()
    def as_many_as_the_model(self) -> None:
        assert self.world.bots.n_bots == len(self.model.last)
        assert len(self.world.connections) == len(self.model.links)


def _recent(everything: list[Any], place: int) -> Any:
    """One of the last few."""
    return everything[-1 - place % min(len(everything), RECENT)]


def _spoilt(numbers: np.ndarray, how: str | None) -> bytes:
    """The bytes, as they are or such that they must be refused with this code."""
    changed = numbers.copy()
    if how in ("NON_FINITE", "OUT_OF_RANGE"):
        changed.flat[-1] = np.nan if how == "NON_FINITE" else 1e7
    return changed.tobytes()[: -4 if how == "BAD_SHAPE" else None]
