"""What can be set about a server, and what must not be combined.

This module knows nothing about how any of it is used; `python -m server --help` is made from it.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path

from protocol.dial import MAX_SPIN_US
from protocol.messages import MAX_DEADLINE_US
from server.tokens import MIN_CHARS, read_token

__all__ = ["Settings"]

_MAX_S = 1e6  # eleven days; timers of the loop know no infinity
_PROCESS = re.compile(r"[a-z0-9]{1,16}")


@dataclass(frozen=True)
class Settings:
    """Serve one bundle, or a store of them, over HTTP, WebSockets and, where asked for, TCP and a Unix socket."""

    bundle: Path | None = None
    """Folder of the bundle to serve; or else:"""
    store: Path | None = None
    """Folder of bundles by name and version, NAME/VERSION/, of which one version of each name is active."""
    signing_key: tuple[Path, ...] = ()
    """Public keys (Ed25519, PEM), one of which must have signed a bundle for it to be served."""
    max_loaded: int = 8
    """Bundles in memory at any time: the active ones, and others that connections still hold."""
    host: str = "127.0.0.1"
    """Address to listen on, for HTTP and TCP."""
    port: int = 8000
    """HTTP port; 0 lets the system pick one (see ready-file)."""
    ws_origins: tuple[str, ...] = ()
    """Web pages that may open WebSockets, as browsers name them: `https://example.org`. Other pages may not; clients
    that are no browsers are not asked."""
    tcp_port: int | None = None
    """Port of the length-prefixed stream; 0 lets the system pick one. Not served unless given."""
    uds: Path | None = None
    """Path of the Unix socket of the same stream. Not served unless given."""
    max_bots: int = 256
    """Bots at any time, over all connections."""
    max_connections: int = 64
    """Connections at any time, and open stream sockets."""
    max_http_sockets: int | None = None
    """Open sockets of the HTTP port, with those that became WebSockets; four times max-connections unless given. Those
    beyond are closed at once."""
    max_queue: int = 64
    """Requests that wait for the inference thread; those beyond are refused with NOT_READY."""
    inline_us: float = 500.0
    """A turn that is known to take no longer than this is answered on the event loop itself, which saves the hop to the
    inference thread and is how long one engine may hold up the others. 0 hands every turn to the thread."""
    spin_us: float = 0.0
    """After each answer the event loop polls for so long before it sleeps, so that the next request of the same turn
    need not wake it. For a server with a core of its own: another process on that core would wait meanwhile."""
    batch_connections: int = 1
    """Turns of at most so many connections are inferred as one batch, where they are found ready together, have 8 bots
    at most and are quick enough for the event loop. 1: each alone. Whether a bot's numbers are the same to the last bit
    then depends on who asked at the same time, for some bundles."""
    idle_ttl_s: float = 60.0
    """A connection that is silent for this long ends, and its bots with it."""
    frame_deadline_s: float = 2.0
    """A client has this long to send one whole request, and to take one whole reply."""
    stuck_after_s: float = 2.0
    """Not ready while one piece of the inference thread's work has been running for this long."""
    default_deadline_us: float | None = None
    """By when after its receipt a turn's request is answered where it does not say. Never unless given."""
    drain_s: float = 5.0
    """After SIGTERM, requests in progress have this long to finish."""
    token: str | None = None
    """What Hello must carry. Required unless the host is a loopback address, and then of at least 16 characters. Who
    lists processes can read it here."""
    token_file: Path | None = None
    """File of one line with that token, instead."""
    admin_token_file: Path | None = None
    """File of one line with the token that activating versions takes. Without it nobody can."""
    insecure_no_token: bool = False
    """Listen on other than loopback addresses without a token: for networks that only trusted machines are on."""
    process: str | None = None
    """Name of this process among several behind one front, lower-case letters and digits: connections' names begin with
    it, so that the front knows where each of them is held."""
    log_json: bool | None = None
    """Log lines of JSON, or of text; by default JSON unless a terminal is watching."""
    otlp_endpoint: str | None = None
    """URL of an OpenTelemetry collector's metrics, such as http://127.0.0.1:4318/v1/metrics: what /metrics says is sent
    there too. Needs the extra `telemetry`."""
    otlp_every_s: float = 15.0
    """How often."""
    ready_file: Path | None = None
    """Written once everything listens: JSON of the addresses (`http`, `ws`, `tcp`, `unix`) and `pid`. Removed at the
    end."""

    def __post_init__(self) -> None:
        if (self.bundle is None) == (self.store is None):
            raise ValueError("give either a bundle or a store")
        if min(self.max_bots, self.max_connections, self.max_queue, self.max_loaded, self.http_sockets) < 1:
            raise ValueError("max_bots, max_connections, max_http_sockets, max_queue and max_loaded must be at least 1")
        for name in ("idle_ttl_s", "frame_deadline_s", "stuck_after_s", "drain_s"):
            if not 0.0 < getattr(self, name) <= _MAX_S:
                raise ValueError(f"{name} is {getattr(self, name)}, expected above 0 and at most {_MAX_S:g}")
        for name in ("port", "tcp_port"):
            if not 0 <= (getattr(self, name) or 0) <= 65535:
                raise ValueError(f"{name} is {getattr(self, name)}, expected 0 to 65535")
        if self.otlp_endpoint is not None and not self.otlp_endpoint.startswith(("http://", "https://")):
            raise ValueError(f"otlp_endpoint is {self.otlp_endpoint[:200]!r}, expected a URL")
        if not self.otlp_every_s >= 0.01:
            raise ValueError(f"otlp_every_s is {self.otlp_every_s}, expected at least 0.01")
        if not self.inline_us >= 0:
            raise ValueError("inline_us must not be negative")
        if not 0 <= self.spin_us <= MAX_SPIN_US:
            raise ValueError(f"spin_us is {self.spin_us}, expected 0 to {MAX_SPIN_US:g}")
        if not 1 <= self.batch_connections <= 64:
            raise ValueError("batch_connections must be 1 to 64")
        if self.process is not None and not _PROCESS.fullmatch(self.process):
            raise ValueError(f"process {self.process[:80]!r} does not match {_PROCESS.pattern}")
        if self.default_deadline_us is not None and not 0 < self.default_deadline_us <= MAX_DEADLINE_US:
            raise ValueError(f"default_deadline_us must be more than 0 and at most {MAX_DEADLINE_US:g}")
        if self.token == "":
            raise ValueError("the token must not be empty")
        if self.token is not None and self.token_file is not None:
            raise ValueError("give the token or its file, not both")
        if self.token is not None and len(self.token) < MIN_CHARS and not _is_loopback(self.host):
            raise ValueError(f"the token has {len(self.token)} characters, expected at least {MIN_CHARS}")
        has_token = self.token is not None or self.token_file is not None
        if not has_token and not self.insecure_no_token and not _is_loopback(self.host):
            raise ValueError(
                f"refusing to listen on {self.host} without a token: anyone could take every bot. "
                "Give --token-file, or --insecure-no-token if only trusted machines reach this network."
            )

    @property
    def http_sockets(self) -> int:
        """How many sockets the HTTP port may have."""
        return 4 * self.max_connections if self.max_http_sockets is None else self.max_http_sockets

    def tokens(self) -> tuple[str | None, str | None]:
        """The token of hellos and that of operators, None where there is none. Raises OSError, ValueError."""
        token = self.token if self.token_file is None else read_token(self.token_file)
        return token, None if self.admin_token_file is None else read_token(self.admin_token_file)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
