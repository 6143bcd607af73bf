"""Changed inputs, drawn from a seed: bytes as a broken line changes them, values in messages as an author would.

This module knows nothing about what is fuzzed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from random import Random
from typing import Any

import msgpack

__all__ = ["changed_bytes", "changed_json", "changed_msgpack"]

_VALUES: list[Any] = [
    None, True, False, 0, 1, 2, 7, 8, -1, 255, 65535, 65536, 2**31, 2**32, 2**53, 2**53 + 1, 2**63 - 1, 2**63,
    2**64 - 1, -(2**63), 0.0, -0.0, 0.5, 1e-320, 1e9, 1.1e9, 3.5e38, 1e308, math.nan, math.inf, -math.inf, "", "a",
    "type", "query", "x" * 1025, "\ud7ff\x00", b"", b"\x00", b"\xff" * 8, b"\x00\x00\xc0\x7f", [], [[]], [0] * 3,
    [[0.5]], {}, {"type": "goodbye"}, msgpack.Timestamp(0, 0), msgpack.ExtType(5, b"abc"),
]  # fmt: skip
_BYTES = bytes.fromhex("00 01 7f 80 90 a0 c0 c1 c4 c7 ca cb cf d9 dc dd de df ff")


def changed_bytes(data: bytes, random: Random) -> bytes:
    """One to four changes of a byte or of a run of them."""
    body = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(body) + 1)
        end = min(len(body), at + random.choice((1, 1, 2, 4, 8, 64)))
        match random.randrange(6):
            case 0:
                body[at:end] = b""
            case 1:
                body[at:at] = random.randbytes(random.choice((1, 2, 4, 9)))
            case 2:
                body[at:at] = body[at:end]
            case 3:
                del body[at:]
            case _ if at < len(body):
                body[at] = random.choice((random.choice(_BYTES), body[at] ^ (1 << random.randrange(8))))
    return bytes(body)


def changed_msgpack(body: bytes, random: Random) -> bytes:
    """The same message with a value changed, moved, missing or added; bytes that are none are changed as bytes."""
    return _rewritten(body, random, msgpack.unpackb, msgpack.packb)


def changed_json(body: bytes, random: Random) -> bytes:
    """As `changed_msgpack`, for JSON."""
    return _rewritten(body, random, json.loads, lambda tree: json.dumps(tree, default=str).encode())


def _rewritten(body: bytes, random: Random, read: Callable[[bytes], Any], write: Callable[[Any], bytes]) -> bytes:
    try:
        tree = read(body)
        for _ in range(random.choice((1, 1, 1, 2, 3))):
            tree = _changed(tree, random)
        return write(tree)
    except (ValueError, TypeError, OverflowError, RecursionError, msgpack.UnpackException):
        return changed_bytes(body, random)


def _changed(tree: Any, random: Random) -> Any:
    """A copy of the tree that differs in one place, drawn by walking down from the root."""
    if isinstance(tree, dict) and tree and random.random() < 0.95:
        tree, key = dict(tree), random.choice(list(tree))
        match random.randrange(10):
            case 0:
                del tree[key]
            case 1:
                tree[random.choice(("x", "frame", "bots", "rewards", "failed", key))] = tree[key]
            case _:
                tree[key] = _changed(tree[key], random)
        return tree
    if isinstance(tree, list) and tree and random.random() < 0.9:
        tree, at = list(tree), random.randrange(len(tree))
        match random.randrange(8):
            case 0:
                del tree[at]
            case 1:
                tree.insert(at, tree[at])
            case 2:
                tree.reverse()
            case _:
                tree[at] = _changed(tree[at], random)
        return tree
    if isinstance(tree, bytes) and tree and random.random() < 0.8:
        return changed_bytes(tree, random)
    if isinstance(tree, int | float) and not isinstance(tree, bool) and random.random() < 0.5:
        return tree + random.choice((1, -1, 2**32, 0.5))
    return random.choice(_VALUES)
