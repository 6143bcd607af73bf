"""The format of a recording, version 1: what bots saw, did and earned, frame by frame. This text is normative.

A file is only ever appended to. Integers outside msgpack are little-endian and unsigned.

    8 bytes         magic: 93 42 4F 54 52 45 43 0A ("\\x93BOTREC\\n")
    u32             version, 1
    block           the header, at most 1 MiB: a map of `features` (FeatureTable), `action` (ActionSpec), `about` (text)
    block ...       records, at most 64 MiB each

    block:  u32     length of the payload
            u32     CRC-32 (that of zlib) of the four bytes of the length and of the payload
            bytes   payload: a msgpack map of at most 15 fields, in its one-byte form (fixmap), as below

A record is one frame of N bots, 1 or more, each named by its episode. All its fields; blobs and bits are those of
PROTOCOL.md in msgpack, never lists:

    session         0 to 2^53. Never goes back; grows whenever the file is opened anew to record
    frame           0 to 2^53
    episodes        [N] different integers, 0 to 2^64 - 1
    free            blob [N, F], within each feature's range
    acquired        bits [N, M]: which costly features were acquired
    values          ragged float32, as in `submit_features`: numbers of acquired features, within each feature's range
    actions         blob [rows not ended, A], within each component's range: what was then done (by an expert: intended)
    rewards         blob [N, 1], within ±1e9: what came since the bot's record before, as in `request_queries`
    terminated      bits [1, N]: this is where the episode ended, by the game's rules
    truncated       bits [1, N]: this is where it was broken off

So the reward for an action stands in the bot's *next* record. The record that ends an episode holds what was last seen
and the reward of the last action, and no action; features need not be acquired for it. A reward in an episode's first
record was earned before, and counts for nothing.

An episode's frames increase, and may leave some out. Within a session an id means one episode until a record ends it,
and then may be used anew; a new session ends every episode before it, as truncated. At most 65,536 are open at once.
N is at most `record.max_bots`, so that a record in which everything was acquired keeps within 64 MiB.

This module holds blocks and the header, `protocol.record` the records; neither knows anything about files.
`protocol.recorder` writes them, `protocol.recording_reader` reads them.
"""

from __future__ import annotations

import struct
import zlib

import msgspec

from protocol import codec
from protocol.codec import Format
from protocol.errors import TooLarge
from protocol.features import ActionSpec, FeatureTable

__all__ = [
    "BLOCK",
    "MAGIC",
    "MAX_HEADER_BYTES",
    "MAX_RECORD_BYTES",
    "PREAMBLE",
    "VERSION",
    "Header",
    "RecordingError",
    "block",
    "decode_header",
    "encode_header",
    "is_intact",
]

MAGIC = b"\x93BOTREC\n"
VERSION = 1
MAX_HEADER_BYTES = 2**20
MAX_RECORD_BYTES = 64 * 2**20
PREAMBLE = struct.Struct("<8sI")  # magic, version
BLOCK = struct.Struct("<II")  # length, CRC
_MAX_ABOUT_BYTES = 4096


class RecordingError(ValueError):
    """A file that is no recording, or not one that can be appended to: which, why, and what was expected."""


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What all records of a recording are of. `about` is free text, such as the environment's id, up to 4,096 bytes."""

    features: FeatureTable
    action: ActionSpec
    about: str = ""

    def __post_init__(self) -> None:
        if len(self.about.encode()) > _MAX_ABOUT_BYTES:
            raise ValueError(f"about has {len(self.about.encode())} bytes, expected {_MAX_ABOUT_BYTES} or less")


def block(payload: bytes) -> bytes:
    """A payload with its length and CRC before it."""
    return BLOCK.pack(len(payload), _crc(payload)) + payload


def is_intact(payload: bytes, crc: int) -> bool:
    """Whether this is the CRC of this payload and of its length."""
    return _crc(payload) == crc


def encode_header(header: Header) -> bytes:
    """The bytes that a file begins with, the same for equal headers. Raises BadSchema, TooLarge."""
    written = codec.encode(header, Format.MSGPACK)
    payload = codec.encode(decode_header(written), Format.MSGPACK)  # 1 and 1.0 are then the same bytes
    if len(payload) > MAX_HEADER_BYTES:
        raise TooLarge(f"the header has {len(payload)} bytes, expected {MAX_HEADER_BYTES} or less")
    return PREAMBLE.pack(MAGIC, VERSION) + block(payload)


def decode_header(payload: bytes) -> Header:
    """The header in its payload; raises as `codec.decode` does."""
    return codec.decode(payload, Format.MSGPACK, Header)


def _crc(payload: bytes) -> int:
    return zlib.crc32(payload, zlib.crc32(len(payload).to_bytes(4, "little")))
