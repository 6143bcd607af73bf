"""One file of a server over HTTP, all of it in memory, within a limit: `GET`, blocking.

This module knows nothing about which files there are.
"""

from __future__ import annotations

import http.client
import ssl
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

from protocol.errors import ERRORS_BY_CODE, InternalError, ProtocolError
from protocol.transport import ReplyError

__all__ = ["fetch"]

_MAX_REFUSAL_BYTES = 65536


class _Refusal(msgspec.Struct):
    code: str = InternalError.code
    detail: str = ""


def fetch(
    url: str, path: str, limit: int, *, token: str | None = None, timeout_s: float = 5.0, cafile: Path | None = None
) -> bytes:
    """The file at `path` of the server `http://host:port` or `https://host:port` (`cafile` as in `BotClient`).

    Raises the ProtocolError that the server answers, ReplyError for what is no such answer or has more than `limit`
    bytes, ValueError for another URL, OSError.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not (parts.hostname and parts.port) or parts.path not in ("", "/"):
        raise ValueError(f"{url!r} is neither http://host:port nor https://host:port")
    asked: http.client.HTTPConnection
    if parts.scheme == "https":
        context = ssl.create_default_context(cafile=cafile)
        asked = http.client.HTTPSConnection(parts.hostname, parts.port, timeout=timeout_s, context=context)
    else:
        asked = http.client.HTTPConnection(parts.hostname, parts.port, timeout=timeout_s)
    try:
        asked.request("GET", path, headers={} if token is None else {"Authorization": f"Bearer {token}".encode()})
        answer = asked.getresponse()
        content = answer.read((limit if answer.status == 200 else _MAX_REFUSAL_BYTES) + 1)
    except http.client.HTTPException as error:
        raise ReplyError(f"not an HTTP answer: {error!r}"[:300]) from error
    finally:
        asked.close()
    if answer.status != 200:
        raise _refusal(answer.status, content)
    if len(content) > limit:
        raise ReplyError(f"{path} has more than {limit} bytes")
    if answer.length:  # `read` with a size takes an early end for the end
        raise ReplyError(f"{path} ended {answer.length} bytes early")
    return content


def _refusal(status: int, content: bytes) -> ProtocolError | ReplyError:
    try:
        refusal = msgspec.json.decode(content, type=_Refusal)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return ReplyError(f"status {status} without a reason")
    return ERRORS_BY_CODE.get(refusal.code, InternalError)(refusal.detail)
