"""Dial: a connected socket to a server, plain or over TLS, asleep or awake while its owner waits for an answer.

This module knows nothing about what travels on it.
"""

from __future__ import annotations

import os
import select
import socket
import ssl
import time
from typing import Protocol

__all__ = ["MAX_SPIN_US", "Socket", "dial"]

MAX_SPIN_US = 10_000.0


class Socket(Protocol):
    """What transports need of a socket."""

    def sendall(self, data: bytes, /) -> None:
        """Send it all. Raises OSError."""

    def recv(self, size: int, /) -> bytes:
        """At most so many bytes, none where the other end has closed. Raises OSError (TimeoutError)."""

    def close(self) -> None:
        """Close it."""


def dial(
    address: tuple[str, int] | str, timeout_s: float, tls: ssl.SSLContext | None = None, spin_us: float = 0.0
) -> Socket:
    """A socket to a host and port, over TLS where there is a context of it, or to a Unix socket's path.

    Whoever reads from it polls for at most `spin_us` before sleeping. Raises OSError (SSLError).
    """
    opened = _unix(address, timeout_s) if isinstance(address, str) else _tcp(address, timeout_s, tls)
    return _Awake(opened, spin_us) if spin_us else opened


class _Awake:
    """A connected socket whose `recv` polls before it blocks; its timeout counts from then.

    Waking a sleeping process takes the kernel longer than a small turn takes the server.
    """

    def __init__(self, opened: socket.socket, spin_us: float) -> None:
        self.sendall, self.close, self._recv = opened.sendall, opened.close, opened.recv
        self._spin_ns = int(spin_us * 1e3)
        poll = select.poll()
        poll.register(opened, select.POLLIN)
        self._poll = poll.poll

    def recv(self, size: int, /) -> bytes:
        until_ns = time.perf_counter_ns() + self._spin_ns
        while not self._poll(0) and time.perf_counter_ns() < until_ns:
            os.sched_yield()  # to the server, where it has no other core
        return self._recv(size)


def _tcp(address: tuple[str, int], timeout_s: float, tls: ssl.SSLContext | None) -> socket.socket:
    opened = socket.create_connection(address, timeout=timeout_s)
    try:
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return opened if tls is None else tls.wrap_socket(opened, server_hostname=address[0])
    except OSError:
        opened.close()
        raise


def _unix(path: str, timeout_s: float) -> socket.socket:
    opened = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        opened.settimeout(timeout_s)
        opened.connect(path)
    except OSError:
        opened.close()
        raise
    return opened
