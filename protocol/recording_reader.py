"""Reading a recording (format: `protocol.recording`): every whole record, and what is left after the last of them.

Whatever the file holds, what comes out is legal records in legal order, RecordingError and OSError. A file may be read
while it is recorded. This module knows nothing about writing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from protocol.episodes import OpenEpisodes
from protocol.errors import ProtocolError
from protocol.record import Record, decode_record
from protocol.recording import (
    BLOCK,
    MAGIC,
    MAX_HEADER_BYTES,
    MAX_RECORD_BYTES,
    PREAMBLE,
    VERSION,
    Header,
    RecordingError,
    decode_header,
    is_intact,
)

__all__ = ["Ending", "Recording", "Tail", "read_recording"]

_TORN = "the file ends within it"
_SEARCH_STEP = 2**20
_MAX_SEARCHED = 2**30  # bytes of checksums: what looks like records must not keep a reader busy for ever
_LOOK_BYTES = 2**10  # what looking at a place costs besides, in such bytes


class Ending(Enum):
    """How a file ends, after its last whole record."""

    WHOLE = "whole"  # with that record
    TORN = "torn"  # within the next record, which was being written
    DAMAGED = "damaged"  # with bytes that are no legal record


class Tail(NamedTuple):
    """What a reader left out. `resumes_at` is where a whole record is found in it, None if there is none.

    It is also where the search gave up, after a GiB of what looked like records.
    """

    ending: Ending
    offset: int  # bytes up to the end of the last whole record
    left_out: int  # bytes after it
    resumes_at: int | None
    reason: str


class Recording:
    """A recording's header, and its records by iteration, as often as wanted."""

    def __init__(self, path: Path, header: Header, begin: int) -> None:
        """`read_recording` makes it."""
        self.path, self.header = path, header
        self._begin = begin
        self._tail: Tail | None = None

    @property
    def tail(self) -> Tail:
        """What the last iteration left out after the last record. Raises RuntimeError until one has come to its end."""
        if self._tail is None:
            raise RuntimeError(f"{self.path} has not been read to its end")
        return self._tail

    def __iter__(self) -> Iterator[Record]:
        self._tail = None
        order, offset = OpenEpisodes(), self._begin
        with self.path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            while offset < size:
                payload, reason = _payload(file, offset, size, MAX_RECORD_BYTES)
                if payload is None:
                    break
                try:
                    record = decode_record(payload, self.header)
                    order.check(record)
                except ProtocolError as error:
                    reason = str(error)
                    break
                order.advance(record)
                offset += BLOCK.size + len(payload)
                yield record
            else:
                reason = ""
            self._tail = _tail(file, offset, size, reason)


def read_recording(path: Path) -> Recording:
    """Open a recording. Raises OSError; RecordingError unless its header is whole, legal and of a known version."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(PREAMBLE.size)
        if start[: len(MAGIC)] != MAGIC[: len(start)]:
            raise RecordingError(
                f"{path} is not a recording: it begins with {start[: len(MAGIC)]!r}, expected {MAGIC!r}"
            )
        if len(start) < PREAMBLE.size:
            raise RecordingError(f"{path} ends within its header, after {size} bytes")
        _, version = PREAMBLE.unpack(start)
        if version != VERSION:
            raise RecordingError(f"{path} is a recording of version {version}, expected {VERSION}")
        payload, reason = _payload(file, PREAMBLE.size, size, MAX_HEADER_BYTES)
        if payload is None:
            raise RecordingError(f"{path}: the header is not whole: {reason}")
        try:
            header = decode_header(payload)
        except ProtocolError as error:
            raise RecordingError(f"{path}: the header is not legal: {error}") from error
    return Recording(path, header, PREAMBLE.size + BLOCK.size + len(payload))


def _payload(file: BinaryIO, offset: int, size: int, limit: int) -> tuple[bytes | None, str]:
    """The payload of the block at `offset`, or None and why there is none. Reads no more than the file has."""
    file.seek(offset)
    start = file.read(BLOCK.size)
    if len(start) < BLOCK.size:
        return None, _TORN
    length, crc = BLOCK.unpack(start)
    if length > limit:
        return None, f"it claims {length} bytes, expected {limit} or less"
    if offset + BLOCK.size + length > size:
        return None, _TORN
    payload = file.read(length)
    if len(payload) < length:  # cut while we read
        return None, _TORN
    return (payload, "") if is_intact(payload, crc) else (None, "its CRC is wrong")


def _tail(file: BinaryIO, offset: int, size: int, reason: str) -> Tail:
    if offset == size:
        return Tail(Ending.WHOLE, offset, 0, None, "")
    resumes_at = _find_record(file, offset, size)
    torn = reason == _TORN and resumes_at is None
    return Tail(Ending.TORN if torn else Ending.DAMAGED, offset, size - offset, resumes_at, reason)


def _find_record(file: BinaryIO, offset: int, size: int) -> int | None:
    """Where the first intact block of a record begins, at `offset` or after; its content is not looked at."""
    budget = _MAX_SEARCHED
    for begin in range(offset, size, _SEARCH_STEP):
        file.seek(begin)
        window = file.read(min(_SEARCH_STEP + BLOCK.size, size - begin))
        for candidate, length in _candidates(window, size - begin):
            budget -= _LOOK_BYTES + length
            if budget < 0 or _payload(file, begin + candidate, size, MAX_RECORD_BYTES)[0] is not None:
                return begin + candidate
    return None


def _candidates(window: bytes, room: int) -> Iterator[tuple[int, int]]:
    """Places in the window where a record could begin, and its payload's length: it fits, and begins as a fixmap."""
    places = len(window) - BLOCK.size
    if places < 1:
        return
    lengths = np.ndarray((places,), dtype="<u4", buffer=window, strides=(1,)).astype(np.int64)
    starts = np.frombuffer(window, dtype=np.uint8)[BLOCK.size :]
    fits = (lengths > 0) & (lengths <= MAX_RECORD_BYTES) & (np.arange(places) + BLOCK.size + lengths <= room)
    fits &= starts >> 4 == 8
    for place in np.flatnonzero(fits).tolist():
        yield place, int(lengths[place])
