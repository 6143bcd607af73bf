"""Assembly: a bundle, its bots, the worker and the doors, opened together and drained together.

This module knows nothing about signals or the command line.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import uvicorn

from bot_runtime.bundle import Bundle
from bot_runtime.signature import Keys
from protocol.transport import SOCKET_PATH
from server.acceptor import Acceptor
from server.admin import AdminDoor, add_routes
from server.catalogue import Catalogue
from server.connections import Connections
from server.crowd import Crowd
from server.desk import Desk
from server.exchange import Exchange
from server.handlers import Handlers
from server.http import HttpDoor, create_app
from server.listening import listen_tcp, listen_unix
from server.metrics import Metrics
from server.observation import watch
from server.probes import Probes
from server.probing import probing
from server.prompt import prompt_http
from server.serving import Serving
from server.servings import Servings
from server.settings import Settings
from server.sockets import Sockets
from server.store import Store
from server.stream import StreamSocket
from server.websocket import web_socket
from server.worker import Worker

if TYPE_CHECKING:  # an extra, imported where it is asked for
    from server.telemetry import Telemetry

__all__ = ["running"]

_CLOSE_S = 0.5  # for what is still running after the drain


@asynccontextmanager
async def running(settings: Settings, *, clock: Callable[[], float] = time.monotonic) -> AsyncIterator[dict[str, str]]:
    """Serve inside the `async with`; yields the addresses by door: `http`, `ws`, `tcp`, `unix`.

    On leaving it is not ready at once, closes idle sockets, answers what is in progress for at most `drain_s`, and
    leaves no thread, socket or file behind. `clock` is what connections age by. Raises BadBundle, OSError.
    """
    token, admin_token = settings.tokens()
    servings = Servings(settings.max_bots, settings.max_loaded)
    connections = Connections(settings.max_connections, settings.idle_ttl_s, clock, process=settings.process)
    handlers = Handlers(servings, connections, token, default_deadline_us=settings.default_deadline_us)
    async with AsyncExitStack() as stack:
        worker = Worker(settings.max_queue)
        stack.callback(worker.close, _CLOSE_S)
        admin = AdminDoor(
            handlers,
            worker,
            _filled(servings, worker, settings),
            admin_token=admin_token,
            body_deadline_s=settings.frame_deadline_s,
        )
        sockets = _sockets(settings, handlers, worker)
        crowd = Crowd(settings.http_sockets)
        readiness, metrics = watch(settings, handlers, connections, worker, sockets, crowd)
        if settings.otlp_endpoint is not None:
            stack.callback(_telemetry(metrics, settings.otlp_endpoint, settings.otlp_every_s).close)
        rest = create_app(HttpDoor(handlers, worker), Probes(handlers, readiness, metrics))
        add_routes(rest, admin)
        application = Exchange(sockets, rest, body_deadline_s=settings.frame_deadline_s)
        uvicorn_server, http_address = await stack.enter_async_context(
            _http(
                settings,
                application,
                prompt_http(settings.frame_deadline_s, crowd, handlers.recorder),
                web_socket(sockets, settings.ws_origins, crowd),
            )
        )
        ws_address = http_address.replace("http://", "ws://") + SOCKET_PATH
        addresses = {
            "http": http_address,
            "ws": ws_address,
            **await stack.enter_async_context(_streams(settings, sockets)),
        }
        await stack.enter_async_context(probing(servings))
        await stack.enter_async_context(_sweeping(handlers, worker, settings.idle_ttl_s / 4))
        try:
            yield addresses
        finally:
            readiness.is_draining = True
            uvicorn_server.should_exit = True  # drains in its own task while the streams are drained here


def _sockets(settings: Settings, handlers: Handlers, worker: Worker) -> Sockets:
    """The desk, and what all doors in front of it share."""
    desk = Desk(
        handlers,
        worker,
        inline_us=settings.inline_us,
        batch_connections=settings.batch_connections,
        default_deadline_us=settings.default_deadline_us,
    )
    return Sockets(
        desk,
        max_sockets=settings.max_connections,
        frame_deadline_s=settings.frame_deadline_s,
        idle_ttl_s=settings.idle_ttl_s,
        spin_us=settings.spin_us,
    )


def _telemetry(metrics: Metrics, endpoint: str, every_s: float) -> Telemetry:
    """Raises ValueError where the extra is not installed."""
    try:
        from server.telemetry import Telemetry
    except ImportError as error:
        raise ValueError(f"--otlp-endpoint needs the extra `telemetry` ({error})") from error
    return Telemetry(metrics, endpoint, every_s)


def _filled(servings: Servings, worker: Worker, settings: Settings) -> Catalogue | None:
    """Load what is to be served; the catalogue of the store if there is one."""
    if settings.store is not None:
        catalogue = Catalogue(
            Store(settings.store), servings, worker, max_bots=settings.max_bots, keys=settings.signing_key
        )
        catalogue.open()
        return catalogue
    if settings.bundle is not None:
        keys = Keys.read(settings.signing_key) if settings.signing_key else None
        servings.activate(Serving(Bundle.load(settings.bundle, keys=keys), max_bots=settings.max_bots))
    return None


class _Uvicorn(uvicorn.Server):
    """uvicorn without its signal handlers, which would end the process by raising the signal again, not with 0.

    Its sockets are accepted as the other doors' are.
    """

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        self.servers = [Acceptor(each, self._protocol) for each in sockets or []]  # type: ignore[misc]

    def _protocol(self) -> asyncio.Protocol:
        make: Callable[..., asyncio.Protocol] = self.config.http_protocol_class
        return make(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)


@asynccontextmanager
async def _http(
    settings: Settings, application: Exchange, protocol: Any, socket_protocol: Any
) -> AsyncIterator[tuple[uvicorn.Server, str]]:
    listening = listen_tcp(settings.host, settings.port)
    server = _Uvicorn(
        uvicorn.Config(
            application,
            http=protocol,
            ws=socket_protocol,
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            date_header=False,
            timeout_keep_alive=max(1, int(settings.idle_ttl_s)),
            timeout_graceful_shutdown=max(1, int(settings.drain_s)),
        )
    )
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    try:
        while not server.started:
            if serving.done():
                serving.result()
            await asyncio.sleep(0.005)
        yield server, f"http://{_host(settings.host)}:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        await serving
        listening.close()


@asynccontextmanager
async def _streams(settings: Settings, sockets: Sockets) -> AsyncIterator[dict[str, str]]:
    addresses: dict[str, str] = {}
    acceptors: list[Acceptor] = []
    try:
        if settings.tcp_port is not None:
            listening = listen_tcp(settings.host, settings.tcp_port)
            acceptors.append(Acceptor(listening, partial(StreamSocket, sockets, "tcp")))
            addresses["tcp"] = f"tcp://{_host(settings.host)}:{listening.getsockname()[1]}"
        if settings.uds is not None:
            acceptors.append(Acceptor(listen_unix(settings.uds), partial(StreamSocket, sockets, "unix")))
            addresses["unix"] = f"unix://{settings.uds.absolute()}"
        yield addresses
    finally:
        if settings.uds is not None and "unix" in addresses:
            settings.uds.unlink(missing_ok=True)  # while it is ours: once it is closed a successor may take its place
        for acceptor in acceptors:
            acceptor.close()
            await acceptor.wait_closed()
        await sockets.drain(settings.drain_s)


@asynccontextmanager
async def _sweeping(handlers: Handlers, worker: Worker, every_s: float) -> AsyncIterator[None]:
    async def sweep() -> None:
        while True:
            await asyncio.sleep(every_s)
            worker.post(handlers.end_silent)

    sweeping = asyncio.create_task(sweep())
    try:
        yield
    finally:
        sweeping.cancel()
        with suppress(asyncio.CancelledError):
            await sweeping


def _host(host: str) -> str:
    return f"[{host}]" if ":" in host else host
