"""ResumingClient: a BotClient whose bots outlive their server.

This module knows nothing about what a message looks like. Whatever ends the connection (the server's death, a cut line,
too long a silence), the next request opens another, starts the bots anew, replays the turns that their contexts consist
of (PROTOCOL.md, *Resume*), and goes on: the caller sees one answer, and that of a run without interruption.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.answered import Answered, Answers
from protocol.client import BotClient
from protocol.errors import NoBot, NoBundle, NoConnection
from protocol.features import CostModel
from protocol.history import History
from protocol.names import Names
from protocol.patience import Patience
from protocol.replay import rebuild
from protocol.replies import Actions, Queries, Welcome
from protocol.transport import ReplyError

__all__ = ["ResumingClient"]

T = TypeVar("T")
Half = TypeVar("Half", Queries, Actions)


class ResumingClient:
    """The interface of BotClient. Bots are named by numbers of this client's own, which stay while handles change.

    A request without an answer is repeated for at most `limit_s` before it raises what a BotClient would have. NoBot
    is raised where bots cannot be resumed, for another bundle is served. Costs that the server learned are learned
    again, from the `cost_model` of `hello` and the turns that are replayed. `resumed` counts how often all this was so,
    `n_late` the answers that came after their deadline, resuming included.
    """

    def __init__(
        self,
        url: str,
        *,
        timeout_s: float = 5.0,
        cafile: Path | None = None,
        spin_us: float = 0.0,
        limit_s: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._client = BotClient(url, timeout_s=timeout_s, cafile=cafile, spin_us=spin_us)
        self._patience = Patience(limit_s, clock, sleep)
        self._said: dict[str, Any] | None = None
        self._welcome: Welcome | None = None
        self._is_held = False  # to the version of bots that were resumed
        self._history = History(1)
        self._names = Names()
        self._turns = Answers(1)  # until hello tells
        self._clock = clock
        self.resumed = self.n_late = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def welcome(self) -> Welcome:
        """See BotClient."""
        if self._welcome is None:
            raise NoConnection("say hello first")
        return self._welcome

    def hello(
        self, *, cost_model: CostModel | None = None, token: str | None = None, bundle: str | None = None
    ) -> Welcome:
        """See BotClient. Raises ReplyError for a server that is too old to be told of turns."""
        self._said = None
        said = {"cost_model": cost_model, "token": token, "bundle": bundle}
        self._welcome = self._client.hello(**said)  # type: ignore[arg-type]
        if self._welcome.replay_frames is None:
            raise ReplyError("this server cannot resume bots: it is older than this client")
        self._said, self._history, self._is_held = said, History(self._welcome.replay_frames), False
        self._names.now, self._turns = {}, Answers(self._welcome.max_bots)
        return self._welcome

    def start(
        self,
        count: int,
        *,
        seeds: Sequence[int] | None = None,
        target_returns: Sequence[float] | None = None,
        budgets_us: Sequence[float] | None = None,
        target_costs_us: Sequence[float] | None = None,
    ) -> NDArray[np.int64]:
        """See BotClient. Without `seeds` the client draws them, for it has to know them."""
        drawn = [secrets.randbits(63) for _ in range(count)] if seeds is None else [int(seed) for seed in seeds]
        limits: dict[str, Any] = {
            "target_returns": target_returns, "budgets_us": budgets_us, "target_costs_us": target_costs_us
        }  # fmt: skip

        def start() -> NDArray[np.int64]:
            return self._client.start(count, seeds=drawn, **limits)

        if self._is_held and not self._history.bots:
            self._client.close()  # the next connection is to whatever is active
        handles_N = self._through(start, start, repeatable=False)
        self._welcome = self._client.welcome
        numbers = self._names.add(handles_N)
        self._history.begin(numbers, drawn, self._welcome.target_return or 0.0, **limits)
        return np.array(numbers, dtype=np.int64)

    def query(
        self,
        bots: ArrayLike,
        frame: int,
        free: ArrayLike,
        rewards: ArrayLike | None = None,
        frame_budget_us: float | None = None,
        budgets_us: ArrayLike | None = None,
        target_costs_us: ArrayLike | None = None,
        deadline_us: float | None = None,
    ) -> Queries:
        """See BotClient."""
        numbers = self._names.known(bots)
        earlier = self._turns.before(numbers, frame, self.resumed)
        if earlier is not None and earlier.queries is not None:
            return earlier.queries
        limits = {"frame_budget_us": frame_budget_us, "budgets_us": budgets_us, "target_costs_us": target_costs_us}
        asked = self._history.ask(numbers, frame, free, rewards, limits)

        def ask() -> Queries:
            now = self._names.handles(numbers)
            return self._client.query(now, frame, free, rewards, deadline_us=deadline_us, **limits)  # type: ignore[arg-type]

        queries = self._timely(ask, ask, deadline_us)
        self._history.count(asked)
        self._turns.keep(Answered(asked, self.resumed, queries))
        return queries

    def act(
        self,
        bots: ArrayLike,
        frame: int,
        acquired: ArrayLike,
        costly: ArrayLike,
        failed: ArrayLike | None = None,
        acquire_us: float | None = None,
        hidden: bool = False,
        deadline_us: float | None = None,
    ) -> Actions:
        """See BotClient. If the server that was asked is gone, the next one is told the whole turn, query and all."""
        numbers = self._names.known(bots)
        earlier = self._turns.before(numbers, frame, self.resumed)
        if earlier is not None and earlier.actions is not None:
            return earlier.actions
        said = {"acquired": acquired, "costly": costly, "failed": failed, "acquire_us": acquire_us}
        turn = self._turns.last(numbers)

        def act() -> Actions:
            return self._client.act(self._names.handles(numbers), frame, hidden=hidden, deadline_us=deadline_us, **said)  # type: ignore[arg-type]

        if turn is None or turn.asked.frame != frame:
            return self._timely(act, act, deadline_us)  # which the server refuses
        asked = turn.asked
        now_said = {**said, **asked.limits, "hidden": hidden, "deadline_us": deadline_us}
        now_said["replayed_returns_to_go"] = asked.left_N

        def tell() -> Actions:
            return turn.told(self._client.take(self._names.handles(numbers), frame, asked.free_NF, **now_said))

        return self._answered(turn, said, self._timely(act if earlier is None else tell, tell, deadline_us))

    def take(
        self,
        bots: ArrayLike,
        frame: int,
        free: ArrayLike,
        acquired: ArrayLike,
        costly: ArrayLike,
        rewards: ArrayLike | None = None,
        failed: ArrayLike | None = None,
        acquire_us: float | None = None,
        frame_budget_us: float | None = None,
        budgets_us: ArrayLike | None = None,
        target_costs_us: ArrayLike | None = None,
        hidden: bool = True,
        deadline_us: float | None = None,
    ) -> Actions:
        """See BotClient."""
        numbers = self._names.known(bots)
        earlier = self._turns.before(numbers, frame, self.resumed)
        if earlier is not None and earlier.actions is not None:
            return earlier.actions
        said = {"acquired": acquired, "costly": costly, "failed": failed, "acquire_us": acquire_us}
        limits = {"frame_budget_us": frame_budget_us, "budgets_us": budgets_us, "target_costs_us": target_costs_us}
        asked = self._history.ask(numbers, frame, free, rewards, limits)
        now_said = {**said, **limits, "rewards": rewards, "hidden": hidden, "deadline_us": deadline_us}

        def take() -> Actions:
            return self._client.take(self._names.handles(numbers), frame, free, **now_said)  # type: ignore[arg-type]

        actions = self._timely(take, take, deadline_us)
        self._history.count(asked)
        return self._answered(Answered(asked, self.resumed), said, actions)

    def stop(self, bots: ArrayLike) -> int:
        """See BotClient."""
        numbers = self._names.known(bots)

        def stop() -> int:
            return self._client.stop(self._names.handles(numbers))

        stopped = self._through(stop, stop, repeatable=False)
        self._history.forget(numbers)
        self._names.forget(numbers)
        self._turns.forget(numbers)
        return stopped

    def close(self) -> None:
        """See BotClient."""
        self._said = None
        self._client.close()

    def _answered(self, turn: Answered, acquired: dict[str, Any], actions: Actions) -> Actions:
        if actions.turns is not None:
            self._history.take(turn.asked, acquired, actions.turns)
        self._turns.keep(turn._replace(resumed=self.resumed, actions=actions))
        return actions

    def _timely(self, first: Callable[[], Half], again: Callable[[], Half], deadline_us: float | None) -> Half:
        """As `_through`; `late` where all of it took longer than the deadline."""
        asked_s = self._clock()
        answer = self._through(first, again)
        limit_us = self.welcome.deadline_us if deadline_us is None else deadline_us
        if limit_us is not None and 1e6 * (self._clock() - asked_s) > limit_us:
            answer = answer._replace(late=True)
        self.n_late += answer.late
        return answer

    def _through(self, first: Callable[[], T], again: Callable[[], T], *, repeatable: bool = True) -> T:
        """The answer to `first`, or to `again` once the bots were resumed."""
        said = self._said
        if said is None:
            raise NoConnection("say hello first")
        resume = partial(self._resume, said)
        return self._patience.answer(first, again, resume, self._client.close, repeatable=repeatable)

    def _resume(self, said: dict[str, Any]) -> None:
        """A new connection with the same bots, their contexts rebuilt. Raises what BotClient does; NoBot.

        Bots can only be rebuilt on the version that they began on; where there are none, any that keeps its promises
        will do.
        """
        was, self._is_held = self.welcome, bool(self._history.bots)
        if self._is_held and was.bundle_version is not None:
            said = {**said, "bundle": f"{was.bundle}@{was.bundle_version}"}
        try:
            welcome = self._client.hello(**said)
        except NoBundle as error:  # another version was activated, and this line was the last to hold the old one
            raise NoBot("another version is served now: the bots cannot be resumed") from error
        is_same = welcome.bundle_sha256 == was.bundle_sha256 or not self._is_held
        if not is_same or (welcome.features, welcome.action) != (was.features, was.action):
            raise NoBot("another bundle is served now: the bots cannot be resumed")
        self._names.now = rebuild(self._client, self._history)
        self._welcome = self._client.welcome
        self.resumed += 1
