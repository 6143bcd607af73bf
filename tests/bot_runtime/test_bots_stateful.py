"""Bots against a reference model that keeps each bot's whole history in lists and knows no arena, slot or vector.

Legal calls must agree; illegal ones must be refused with the reference's error and change nothing in either.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle as Kept
from hypothesis.stateful import RuleBasedStateMachine, invariant, multiple, rule, run_state_machine_as_test

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.noise import uniforms
from bot_runtime.policy import Policy
from protocol import errors

MAX_BOTS = 4
STEPS = st.sampled_from([-1, 0, 0, 1, 1, 1, 3])  # from the newest frame: back, again, on, a gap
ORDERS = st.sampled_from([range(MAX_BOTS), range(MAX_BOTS), [3, 1, 0, 2]])
CONTENTS = st.sampled_from([0, 0, 1])


@dataclass
class Asked:
    """One message's query: the bots it named and what retries must equal."""

    frame: int
    handles: list[int]
    content: tuple[int, float]
    query: np.ndarray
    submitted: int | None = None
    action: np.ndarray | None = None


@dataclass
class ReferenceBot:
    seed: int
    left: float
    past: list[np.ndarray] = field(default_factory=list)  # [L, 2, H, d] a turn
    hidden: np.ndarray | None = None
    prepared: np.ndarray | None = None
    asked: Asked | None = None


class Reference:
    """One bot at a time, through the policy's two calls with N = 1."""

    def __init__(self, bundle: Bundle) -> None:
        self.manifest, self.policy = bundle.manifest, Policy(bundle)
        self.bots: dict[int, ReferenceBot] = {}

    def noise(self, bot: ReferenceBot) -> np.ndarray:
        count = self.manifest.features.n_queries + self.manifest.action.size
        return uniforms(np.array([bot.seed], dtype=np.uint64), np.array([len(bot.past)]), count)

    def probs(self, bot: ReferenceBot, free: np.ndarray, left: float) -> np.ndarray:
        batch = Contexts(self.manifest, 1).batch(np.array([0]))
        batch.free_NF[:], batch.left_N1[:], batch.target_cost_N1[:] = free, left, 1.0
        if bot.hidden is not None:
            batch.past_NW[:] = bot.hidden
        self.policy.query_probs(batch)
        bot.prepared = batch.asked_NE.copy()
        return batch.probs_NM

    def act(self, bot: ReferenceBot, costly: np.ndarray, query: np.ndarray) -> np.ndarray:
        batch, turn, slots = Contexts(self.manifest, 1).batch(np.array([0])), len(bot.past), self.manifest.n_slots
        for t in range(max(0, turn - slots), turn):
            batch.memory[:, :, 0, :, t % slots] = bot.past[t]
        if slots:
            batch.place_N[:] = turn if turn < slots else slots + turn % slots
        batch.prepared_NE[:], batch.noise_NA[:] = bot.prepared, self.noise(bot)[:, self.manifest.features.n_queries :]
        batch.costly_ND[:], batch.query_NM[:] = costly * query[self.manifest.features.owner], query
        self.policy.act(batch)
        bot.past.append(batch.tokens[:, :, 0].copy())
        bot.hidden = batch.hidden_NW[0].copy()
        return batch.action_NA[0]

    def query_error(self, handles: list[int], frame: int, content: tuple[int, float]) -> type[Exception] | None:
        if any(handle not in self.bots for handle in handles):
            return errors.NoBot
        turns = [self.bots[handle].asked for handle in handles]
        if any(turn is not None and frame < turn.frame for turn in turns):
            return errors.StaleFrame
        repeated = [turn for turn in turns if turn is not None and turn.frame == frame]
        if repeated and (
            repeated[0].handles != handles or repeated[0].content != content or len(repeated) < len(turns)
        ):
            return errors.FrameReused
        return None

    def submit_error(self, handles: list[int], frame: int) -> set[type[Exception]]:
        if any(handle not in self.bots for handle in handles):
            return {errors.NoBot}
        turns, refused = [self.bots[handle].asked for handle in handles], set()
        if any(turn is not None and frame < turn.frame for turn in turns):
            refused.add(errors.StaleFrame)
        if any(turn is None or frame > turn.frame for turn in turns):
            refused.add(errors.NoPendingQuery)
        if not refused and (any(turn is not turns[0] for turn in turns) or turns[0].handles != handles):
            refused.add(errors.NoPendingQuery)
        return refused


class BotsMachine(RuleBasedStateMachine):
    """Two contents (seeds of the values) and frames near the newest, so that turns, retries and reuse happen often."""

    handles = Kept("handles")

    def __init__(self, served: Bundle) -> None:
        super().__init__()
        self.bots, self.reference = Bots(served, max_bots=MAX_BOTS, first_generation=1), Reference(served)
        self.table = served.manifest.features
        self.newest, self.used = 0, set()

    def at(self, step: int) -> int:
        frame = max(0, self.newest + step)
        self.newest = max(self.newest, frame)
        return frame

    def values(self, frame: int, content: int, handle: int, limits: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        low, high = (np.clip(limit, -3.0, 3.0) for limit in limits)
        return np.random.default_rng([frame, content, handle & 0xFF]).uniform(low, high).astype(np.float32)

    @rule(target=handles, count=st.integers(1, 3), seed=st.integers(0, 2**64 - 1))
    def start(self, count: int, seed: int) -> object:
        if len(self.reference.bots) + count > MAX_BOTS:
            with pytest.raises(errors.TooManyBots):
                self.bots.start(count)
            return multiple()
        started = self.bots.start(count, seeds=[seed] * count, target_returns=[5.0] * count, budgets_us=[1e6] * count)
        for handle in started.tolist():
            assert handle not in self.used
            self.used.add(handle)
            self.reference.bots[handle] = ReferenceBot(seed, 5.0)
        return multiple(*started.tolist())

    @rule(handle=handles)
    def stop(self, handle: int) -> None:
        if handle in self.reference.bots:
            del self.reference.bots[handle]
            assert self.bots.stop(np.array([handle])) == 1
        with pytest.raises(errors.NoBot):
            self.bots.stop(np.array([handle]))

    @rule(named=st.lists(handles, min_size=1, max_size=3, unique=True), step=STEPS, content=CONTENTS)
    def ask_some(self, named: list[int], step: int, content: int) -> None:
        self._ask(named, self.at(step), content)

    @rule(order=ORDERS, step=STEPS, content=CONTENTS, submit=st.booleans())
    def ask_all(self, order: list[int], step: int, content: int, submit: bool) -> None:
        alive, frame = list(self.reference.bots), self.at(step)
        named = [alive[place] for place in order if place < len(alive)]
        if named:
            self._ask(named, frame, content)
        if named and submit:
            self._submit(named, frame, content)

    def _ask(self, named: list[int], frame: int, content: int) -> None:
        reward = 0.5 * content
        free = np.stack([self.values(frame, content, handle, self.table.free_range) for handle in named])
        refused = self.reference.query_error(named, frame, (content, reward))
        if refused:
            with pytest.raises(refused):
                self.bots.request_queries(np.array(named), frame, free, [reward] * len(named))
            return
        queries = self.bots.request_queries(np.array(named), frame, free, [reward] * len(named))
        repeated = self.reference.bots[named[0]].asked
        if repeated is not None and repeated.frame == frame:
            assert queries.query_NM is repeated.query
            return
        asked = Asked(frame, named, (content, reward), queries.query_NM)
        for row, handle in enumerate(named):
            bot = self.reference.bots[handle]
            bot.left -= reward
            probs = self.reference.probs(bot, free[row], bot.left)
            np.testing.assert_allclose(queries.probs_NM[row], probs[0], atol=1e-5)
            drawn = self.reference.noise(bot)[0, : self.table.n_queries] < queries.probs_NM[row]
            assert np.array_equal(queries.query_NM[row], drawn)
            bot.asked = asked

    @rule(named=st.lists(handles, min_size=1, max_size=3, unique=True), step=STEPS, content=CONTENTS)
    def submit_some(self, named: list[int], step: int, content: int) -> None:
        self._submit(named, self.at(step), content)

    @rule(handle=handles, content=CONTENTS)
    def submit_pending(self, handle: int, content: int) -> None:
        bot = self.reference.bots.get(handle)
        if bot is not None and bot.asked is not None:
            self._submit(bot.asked.handles, bot.asked.frame, content)

    def _submit(self, named: list[int], frame: int, content: int) -> None:
        costly = np.stack([self.values(frame, content, handle, self.table.costly_range) for handle in named])
        refused = self.reference.submit_error(named, frame)
        asked = None if refused else self.reference.bots[named[0]].asked
        query = np.zeros((len(named), self.table.n_queries), dtype=np.bool_) if asked is None else asked.query
        if asked is not None and asked.submitted not in (None, content) and query.any():
            refused = {errors.FrameReused}
        if refused:
            with pytest.raises(tuple(refused)):
                self.bots.submit_features(np.array(named), frame, query, costly)
            return
        actions = self.bots.submit_features(np.array(named), frame, query, costly)
        if asked.submitted is not None:
            assert actions.action_NA is asked.action
            return
        asked.submitted, asked.action = content, actions.action_NA
        for row, handle in enumerate(named):
            expected = self.reference.act(self.reference.bots[handle], costly[row], query[row])
            np.testing.assert_allclose(actions.action_NA[row], expected, atol=1e-4)

    @invariant()
    def as_many_bots_as_the_reference(self) -> None:
        assert self.bots.n_bots == len(self.reference.bots)


@pytest.mark.parametrize(("kind", "examples"), [("bundle", 80), ("memoryless", 20)])
def test_agrees_with_the_reference(kind: str, examples: int, request: pytest.FixtureRequest) -> None:
    bundle = request.getfixturevalue(kind)
    steps = settings(max_examples=examples, stateful_step_count=40, derandomize=True, deadline=None)
    run_state_machine_as_test(lambda: BotsMachine(bundle), settings=steps)
