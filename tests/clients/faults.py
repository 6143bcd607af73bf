"""Replies that are not what the protocol says, made of golden ones."""

from __future__ import annotations

import random
import struct
from typing import Any

import msgpack

from tests.protocol.golden import VECTORS

__all__ = ["frame_of", "mutated", "plain", "without"]

_HEADS = bytes([0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, *range(0xC0, 0xE0), 0xFF, 0, 0x7F])


def frame_of(message: Any) -> bytes:
    body = msgpack.packb(message)
    return struct.pack(">I", len(body)) + body


def plain(name: str, **changed: Any) -> dict[str, Any]:
    """A golden reply as msgpack has it, with other values in some fields."""
    return {**msgpack.unpackb(VECTORS[name].body), **changed}


def without(name: str, *fields: str) -> dict[str, Any]:
    return {field: value for field, value in plain(name).items() if field not in fields}


def mutated(body: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """The same with one to three faults: bytes changed, cut out, put in, or taken from another reply."""
    mutant = bytearray(body)
    for _ in range(rng.randint(1, 3)):
        at = rng.randrange(len(mutant) + 1)
        match rng.randrange(6):
            case 0 if at < len(mutant):
                mutant[at] ^= 1 << rng.randrange(8)
            case 1 if at < len(mutant):
                mutant[at] = rng.choice(_HEADS)
            case 2:
                del mutant[at:]
            case 3:
                del mutant[at : at + rng.randint(1, 8)]
            case 4:
                mutant[at:at] = bytes([rng.choice(_HEADS)]) + rng.randbytes(rng.randrange(9))
            case 5:
                other = rng.choice(others)
                start = rng.randrange(len(other))
                mutant[at:at] = other[start : start + rng.randint(1, 40)]
    return bytes(mutant)
