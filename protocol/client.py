"""BotClient: the blocking client that clients in other languages follow, over HTTP, WebSocket, TCP or a Unix socket.

This module knows nothing about bots or how the server reads what it sends: it packs and unpacks with the `msgpack`
package, plain dicts and numpy, on purpose not with `protocol.codec`. Shape letters as in `protocol.features`.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, ParamSpec, Self, TypeVar

import msgpack
import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.errors import NoConnection, ProtocolError, TooManyConnections
from protocol.features import CostModel
from protocol.packing import FLOAT, add_acquired, add_number, add_numbers, cost_model_dict, handles_of, matrix
from protocol.replies import (
    Actions,
    Queries,
    Welcome,
    read_actions,
    read_bots_started,
    read_bots_stopped,
    read_queries,
    read_reply,
    read_welcome,
)
from protocol.transport import ReplyError, open_transport

__all__ = ["Actions", "BotClient", "Queries", "ReplyError", "Welcome"]

P = ParamSpec("P")
T = TypeVar("T")


class BotClient:
    """One connection to a server at `http://host:port`, `ws://host:port`, `tcp://host:port` or `unix:///path`.

    Every method raises the ProtocolError of the server's answer; OSError (TimeoutError, ConnectionError, ReplyError)
    where there is none. A socket that failed is closed: over HTTP the next call opens another and the connection goes
    on; over TCP and Unix sockets the connection and its bots have ended, so say hello again. `timeout_s` is of each
    wait for the server, not of a whole call: one that sends a byte now and then is waited for.
    """

    def __init__(
        self,
        url: str,
        *,
        timeout_s: float = 5.0,
        cafile: Path | None = None,
        spin_us: float = 0.0,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`https`, `wss` and `tcps` speak TLS; `cafile` has the authorities to trust where not those of the system.

        An answer is polled for during `spin_us` before the thread sleeps until it comes: for a thread with a core.
        `clock` counts ns and is monotonic: `n_late` answers came too late by it, or left so by the server's.
        """
        self._transport = open_transport(url, timeout_s, cafile=cafile, spin_us=spin_us)
        self._packer = msgpack.Packer()  # kept, for each begins with a large buffer
        self._welcome: Welcome | None = None
        self._clock = clock
        self.n_late = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def welcome(self) -> Welcome:
        """What counts for this connection, with the version of the bots that were started last; raises NoConnection."""
        if self._welcome is None:
            raise NoConnection("say hello first")
        return self._welcome

    def hello(
        self, *, cost_model: CostModel | None = None, token: str | None = None, bundle: str | None = None
    ) -> Welcome:
        """Open a connection, with the engine's own cost model if it has measured one.

        `bundle` is a name, of which bots are started on the version that is then active, or NAME@VERSION, of that
        version only. Another connection of this client ends with its socket or, over HTTP, when the server has not
        heard of it for long enough: `close` ends it at once.
        """
        if self._welcome is not None:
            self._transport.close()
        self._welcome = None
        message: dict[str, Any] = {"type": "hello", "protocol": 1}
        if cost_model is not None:
            message["cost_model"] = cost_model_dict(cost_model)
        if token is not None:
            message["token"] = token
        if bundle is not None:
            message["bundle"] = bundle
        self._welcome = self._read(read_welcome, self.exchange(message))
        return self._welcome

    def start(
        self,
        count: int,
        *,
        seeds: Sequence[int] | None = None,
        target_returns: Sequence[float] | None = None,
        budgets_us: Sequence[float] | None = None,
        target_costs_us: Sequence[float] | None = None,
        turns: Sequence[int] | None = None,
    ) -> NDArray[np.int64]:
        """Start bots; each sequence, where given, has one entry a bot. Returns their handles, int64 [count].

        `turns` are those that they took before, at a server that is gone: see `protocol.resuming`.
        """
        message: dict[str, Any] = {"type": "start_bots", "count": int(count)}
        if seeds is not None:
            message["seeds"] = [int(seed) for seed in seeds]
        add_numbers(message, "target_returns", target_returns)
        add_numbers(message, "budgets_us", budgets_us)
        add_numbers(message, "target_costs_us", target_costs_us)
        if turns is not None:
            message["turns"] = [int(taken) for taken in turns]
        handles_N, self._welcome = self._read(read_bots_started, self.exchange(message), self.welcome, int(count))
        return handles_N

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
        """Ask which costly features to acquire, given `free` [N, F] and the `rewards` [N] since each bot's last frame.

        `frame_budget_us` is shared by all these bots, on top of each bot's own budget. `budgets_us` and
        `target_costs_us` [N] replace those of the bots' start for this frame only. `deadline_us` is how long after the
        server has received this its answer must leave; one that cannot be decided by then asks for nothing and says
        so in `reasons`. Raises BadShape locally too.
        """
        table, handles = self.welcome.features, handles_of(bots)
        message = {"type": "request_queries", "frame": operator.index(frame), "bots": handles}
        message["free"] = matrix(free, FLOAT, (len(handles), table.n_free), "free").tobytes()
        add_numbers(message, "rewards", rewards)
        add_number(message, "frame_budget_us", frame_budget_us)
        add_numbers(message, "budgets_us", budgets_us)
        add_numbers(message, "target_costs_us", target_costs_us)
        add_number(message, "deadline_us", deadline_us)
        return self._read(read_queries, self._framed(message), len(handles), table)

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
        """Answer the pending query of the same bots and frame, and get their actions.

        `acquired` and `failed` are bool [N, M], together exactly what was asked for; `costly` is [N, D], of which only
        the acquired numbers are read and sent. `acquire_us` is what acquiring all of this took: the server then keeps
        budgets by what it measures, if its welcome has a `cost_quantile`. `hidden` asks for the hidden state, which a
        head in the engine reads. `deadline_us` is as in `query`: what is not decided by then is the last action, or a
        safe one. Raises BadShape locally too.
        """
        welcome, handles = self.welcome, handles_of(bots)
        message = {"type": "submit_features", "frame": operator.index(frame), "bots": handles}
        add_acquired(message, welcome.features, len(handles), acquired, costly, failed)
        add_number(message, "acquire_us", acquire_us)
        add_number(message, "deadline_us", deadline_us)
        if hidden:
            message["hidden"] = True
        return self._read(read_actions, self._framed(message), len(handles), welcome.action)

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
        replayed_returns_to_go: ArrayLike | None = None,
        deadline_us: float | None = None,
    ) -> Actions:
        """A whole turn in one round trip, where the engine has decided what to acquire; arguments as in both halves.

        `bot_runtime.head.Head` decides as the server would. A server knows this whose welcome has `replay_frames`.
        Raises OverBudget where what was acquired or failed costs more than a budget; BadShape locally too.
        """
        welcome, handles = self.welcome, handles_of(bots)
        table, message = welcome.features, {"type": "take_turn", "frame": operator.index(frame), "bots": handles}
        message["free"] = matrix(free, FLOAT, (len(handles), table.n_free), "free").tobytes()
        add_acquired(message, table, len(handles), acquired, costly, failed)
        add_numbers(message, "rewards", rewards)
        add_number(message, "acquire_us", acquire_us)
        add_number(message, "frame_budget_us", frame_budget_us)
        add_numbers(message, "budgets_us", budgets_us)
        add_numbers(message, "target_costs_us", target_costs_us)
        if hidden:
            message["hidden"] = True
        add_numbers(message, "replayed_returns_to_go", replayed_returns_to_go)
        add_number(message, "deadline_us", deadline_us)
        return self._read(read_actions, self._framed(message), len(handles), welcome.action)

    def stop(self, bots: ArrayLike) -> int:
        """End these bots; returns how many ended."""
        return self._read(read_bots_stopped, self.exchange({"type": "stop_bots", "bots": handles_of(bots)}))

    def close(self) -> None:
        """End the connection and its bots, and close the socket. A server that is gone already is no error."""
        try:
            if self._welcome is not None:
                self.exchange({"type": "goodbye"})
        except (OSError, ProtocolError):
            pass  # the connection has ended, which is what was asked for
        finally:
            self._welcome = None
            self._transport.close()

    def exchange(self, message: dict[str, Any]) -> dict[str, Any]:
        """Send any message, as a dict, and return its reply's dict: the door for tests and for messages to come."""
        connection = None if self._welcome is None else self._welcome.connection
        body = self._transport.exchange(message["type"], self._packer.pack(message), connection)
        return self._read(read_reply, body, message["type"])

    def _read(self, read: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        try:
            return read(*arguments, **named)
        except (NoConnection, TooManyConnections, ReplyError):  # nothing sensible will be answered on this socket
            self._transport.close()
            raise

    def _framed(self, message: dict[str, Any]) -> dict[str, Any]:
        asked_ns = self._clock()
        reply = self.exchange(message)
        if reply.get("frame") != message["frame"]:
            self._transport.close()
            raise ReplyError(f"the reply is for frame {reply.get('frame')!r}, expected {message['frame']}")
        deadline_us = message.get("deadline_us", self.welcome.deadline_us)
        if deadline_us is not None and self._clock() - asked_ns > 1e3 * deadline_us:
            reply["late"] = True  # whatever the server says, who cannot know when this was sent or came
        self.n_late += bool(reply.get("late"))
        return reply
