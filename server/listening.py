"""Sockets that listen. This module knows nothing about who accepts on them."""

from __future__ import annotations

import errno
import socket
import stat
from pathlib import Path

__all__ = ["SEND_BYTES", "listen_tcp", "listen_unix"]

SEND_BYTES = 2**16
"""Of answers that a client over TCP does not take; the system's own limit grows to megabytes a socket."""

_BACKLOG = 512


def listen_tcp(host: str, port: int) -> socket.socket:
    """A listening socket that says it is TCP: asyncio turns Nagle's algorithm off only for those, 40 ms an answer.

    Raises OSError.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)  # and of all that are accepted
        return _begun(listening, (host, port))
    except OSError:
        listening.close()
        raise


def listen_unix(path: Path) -> socket.socket:
    """A listening Unix socket in the place of one that nobody listens on any more. Raises OSError where somebody does,
    and for another file."""
    if path.exists() and stat.S_ISSOCK(path.stat().st_mode):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.setblocking(False)
            if probe.connect_ex(str(path)) != errno.ECONNREFUSED:
                raise OSError(errno.EADDRINUSE, f"a server listens on {path}")
        path.unlink()
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        return _begun(listening, str(path))
    except OSError:
        listening.close()
        raise


def _begun(listening: socket.socket, address: tuple[str, int] | str) -> socket.socket:
    listening.bind(address)
    listening.listen(_BACKLOG)
    listening.setblocking(False)
    return listening
