"""`python -m server`, but every reply is kept for ever: the control that a soak must not let pass.

The leak is put in from outside; nothing of the server itself differs.
"""

from __future__ import annotations

import msgspec

from protocol import codec
from protocol.codec import Format
from server.__main__ import main

__all__: list[str] = []

_BESIDE_BYTES = 16384  # kept with each reply, as its request and what was made for it might be
_encode = codec.encode
_kept: list[bytes] = []


def _keeping(message: msgspec.Struct, form: Format) -> bytes:
    reply = _encode(message, form)
    _kept.append(reply + b"\x01" * _BESIDE_BYTES)
    return reply


if __name__ == "__main__":
    codec.encode = _keeping
    main()
