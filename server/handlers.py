"""What each message does: the one place where messages meet bots, for every transport.

This module knows nothing about sockets, HTTP or bytes. It runs on one thread at a time: the worker's, or the event
loop's while the worker is idle (`server.desk`). Everything is checked before any bot is touched, so a refused request
leaves every bot as it was.
"""

from __future__ import annotations

import numpy as np
from msgspec.structs import replace

from bot_runtime.costs import Report
from bot_runtime.deadline import Deadline
from bot_runtime.inputs import check_costs, per_bot
from bot_runtime.work import Steps
from protocol import arrays
from protocol.codec import Format
from protocol.errors import BadSchema
from protocol.features import CostModel
from protocol.messages import (
    MAX_DEADLINE_US,
    PROTOCOL_VERSION,
    Actions,
    BotsStarted,
    BotsStopped,
    Farewell,
    Goodbye,
    Hello,
    Queries,
    Reply,
    Request,
    RequestQueries,
    StartBots,
    StopBots,
    SubmitFeatures,
    TakeTurn,
    Welcome,
)
from server.connections import Connection, Connections
from server.logs import digest, logger
from server.recorder import Recorder
from server.serving import Serving
from server.servings import Servings
from server.tokens import check
from server.written import written

__all__ = ["Handlers"]

_log = logger(__name__)


class Handlers:
    """Answers requests of known connections with bots of these servings. `token` is what Hello must carry, if any.

    `recorder` is where whoever hands on requests counts them. `default_deadline_us` is what Welcome says of requests
    that name no deadline.
    """

    def __init__(
        self,
        servings: Servings,
        connections: Connections,
        token: str | None,
        *,
        default_deadline_us: float | None = None,
    ) -> None:
        self.servings = servings
        self.connections = connections
        self._token = token
        self._default_deadline_us = default_deadline_us
        self.recorder = Recorder()

    def max_bytes(self, connection_id: str | None, form: Format) -> int:
        """The longest message that is read from this connection, or from a stranger: hello. Safe from any thread."""
        is_known = self.connections.peek(connection_id) is not None
        return (self.servings.max_body_bytes if is_known else self.servings.max_hello_bytes)[form]

    def steps(
        self, request: Request, connection_id: str | None, form: Format, deadline: Deadline | None = None
    ) -> Steps[Reply]:
        """The reply to one request, its blobs written for `form`. Raises ProtocolError, having done nothing."""
        if isinstance(request, Hello):
            return self._hello(request, connection_id, form)
        connection = self.connections.get(connection_id)
        match request:
            case RequestQueries():
                return (yield from self._request_queries(request, connection, form, deadline))
            case SubmitFeatures():
                return (yield from self._submit_features(request, connection, form, deadline))
            case TakeTurn():
                return (yield from self._take_turn(request, connection, form, deadline))
            case StartBots():
                return self._start_bots(request, connection)
            case StopBots():
                return self._stop_bots(request, connection)
            case Goodbye():
                self.end(connection.id, "goodbye")
                return Farewell()

    def end(self, connection_id: str, why: str = "socket closed") -> None:
        """End a connection and its bots; one that has ended already is no error."""
        connection = self.connections.remove(connection_id)
        if connection is not None:
            self._let_go(connection, why)

    def end_silent(self) -> None:
        """End every connection that has been silent for longer than its time to live."""
        for connection in self.connections.silent():
            self.end(connection.id, "silence")

    def costs(self) -> list[Report]:
        """What acquiring costs each connection's engine, in the order in which they connected."""
        return [connection.costs.report() for connection in self.connections]

    def check_token(self, token: str | None) -> None:
        """Raise Unauthorized unless this is the server's token, or it has none. Takes equally long either way."""
        if self._token is not None:
            check(token, self._token)

    def _hello(self, hello: Hello, connection_id: str | None, form: Format) -> Welcome:
        self.check_token(hello.token)
        if self.connections.heard(connection_id) is not None:  # one that was silent for too long is over
            raise BadSchema("this socket has said hello already: it carries one connection")
        if hello.protocol != PROTOCOL_VERSION:
            raise BadSchema(f"protocol {hello.protocol} is not spoken here, expected {PROTOCOL_VERSION}")
        serving = self.servings.named(hello.bundle)
        cost_model = hello.cost_model or CostModel.declared(serving.table)
        check_costs(cost_model, serving.table)
        is_pinned = hello.bundle is not None and "@" in hello.bundle
        self.servings.hold(serving)  # first: the last connection that held it may be among those that are silent
        try:
            self.end_silent()
            connection = self.connections.open(cost_model, serving, is_pinned=is_pinned)
        except BaseException:
            self.servings.release(serving)
            raise
        welcome = serving.welcome(connection.id, cost_model, connection.costs.quantile, form)
        return replace(welcome, deadline_us=self._default_deadline_us)

    def _start_bots(self, request: StartBots, connection: Connection) -> BotsStarted:
        serving = self._serving_of_next_bots(connection)
        self.servings.check_room(request.count)
        handles = serving.bots.start(
            request.count,
            seeds=request.seeds,
            target_returns=request.target_returns,
            budgets_us=request.budgets_us,
            target_costs_us=request.target_costs_us,
            cost_model=connection.costs.declared,
            turns=request.turns,
        ).tolist()
        if serving is not connection.serving:
            self.servings.hold(serving)
            self.servings.release(connection.serving)
            connection.serving, connection.asked = serving, None
        connection.bots.update(handles)
        return BotsStarted(bots=handles, bundle_version=serving.version, bundle_sha256=serving.sha256)

    def _serving_of_next_bots(self, connection: Connection) -> Serving:
        """A connection has bots of one version at a time, so that no message ever names bots of two."""
        if connection.bots or connection.is_pinned:
            return connection.serving
        return self.servings.successor(connection.serving)

    def _request_queries(
        self, request: RequestQueries, connection: Connection, form: Format, deadline: Deadline | None
    ) -> Steps[Queries | Actions]:
        connection.check_owns(request.bots)
        _check_deadline(request.deadline_us)
        serving = connection.serving
        free_NF = arrays.floats(request.free, (len(request.bots), serving.table.n_free), "free")
        handles_N = np.array(request.bots, dtype=np.int64)
        turn = yield from serving.bots.query_steps(
            handles_N,
            request.frame,
            free_NF,
            request.rewards,
            request.frame_budget_us,
            request.budgets_us,
            request.target_costs_us,
            connection.measured_costs,
            deadline,
        )
        reply = written(turn, form)
        connection.asked = reply.queries, turn.query_NM
        return reply

    def _submit_features(
        self, request: SubmitFeatures, connection: Connection, form: Format, deadline: Deadline | None
    ) -> Steps[Queries | Actions]:
        connection.check_owns(request.bots)
        _check_deadline(request.deadline_us)
        serving = connection.serving
        shape = len(request.bots), serving.table.n_queries
        acquired_NM = connection.query_of(request.acquired, shape[0])
        if acquired_NM is None:
            acquired_NM = arrays.bits(request.acquired, shape, "acquired")
        failed_NM = None if request.failed is None else arrays.bits(request.failed, shape, "failed")
        costly_ND = arrays.unpack_values(request.values, acquired_NM, serving.table)
        handles_N = np.array(request.bots, dtype=np.int64)
        turn = yield from serving.bots.feature_steps(
            handles_N, request.frame, acquired_NM, costly_ND, failed_NM, request.acquire_us, connection.costs, deadline
        )
        return written(turn, form, serving.bots.hidden(handles_N) if request.hidden else None)

    def _take_turn(
        self, request: TakeTurn, connection: Connection, form: Format, deadline: Deadline | None
    ) -> Steps[Queries | Actions]:
        connection.check_owns(request.bots)
        _check_deadline(request.deadline_us)
        serving, n_bots = connection.serving, len(request.bots)
        acquired_NM = arrays.bits(request.acquired, (n_bots, serving.table.n_queries), "acquired")
        handles_N = np.array(request.bots, dtype=np.int64)
        turn = yield from serving.bots.turn_steps(
            handles_N,
            request.frame,
            arrays.floats(request.free, (n_bots, serving.table.n_free), "free"),
            acquired_NM,
            arrays.unpack_values(request.values, acquired_NM, serving.table),
            None if request.failed is None else arrays.bits(request.failed, acquired_NM.shape, "failed"),
            request.rewards,
            request.frame_budget_us,
            request.budgets_us,
            request.target_costs_us,
            request.acquire_us,
            connection.costs,
            request.replayed_returns_to_go,
            deadline,
        )
        return written(turn, form, serving.bots.hidden(handles_N) if request.hidden else None)

    def _stop_bots(self, request: StopBots, connection: Connection) -> BotsStopped:
        connection.check_owns(request.bots)
        return BotsStopped(count=self._stop(connection, request.bots))

    def _stop(self, connection: Connection, handles: list[int]) -> int:
        stopped = connection.serving.bots.stop(np.array(handles, dtype=np.int64)) if handles else 0
        connection.bots.difference_update(handles)
        return stopped

    def _let_go(self, connection: Connection, why: str) -> None:
        """Stop what a connection that is gone has left."""
        _log.info("connection ended", connection=digest(connection.id), bots=len(connection.bots), why=why)
        self._stop(connection, list(connection.bots))
        self.servings.release(connection.serving)


def _check_deadline(deadline_us: float | None) -> None:
    """Raises NonFinite, OutOfRange."""
    if deadline_us is not None:
        per_bot("deadline_us", (deadline_us,), 1, 0.0, MAX_DEADLINE_US)
