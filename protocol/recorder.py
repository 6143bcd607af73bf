"""Recorder: an engine's own record of what its bots saw, did and earned, kept whatever happens to the engine.

The format is that of `protocol.recording`. This module knows nothing about servers or who plays: a player, a script
or a served bundle.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from protocol.episodes import OpenEpisodes
from protocol.messages import MAX_FRAME
from protocol.record import Record, checked_record, encode_record
from protocol.recording import Header, RecordingError, encode_header
from protocol.recording_reader import read_recording

if sys.platform != "win32":
    import fcntl

__all__ = ["Recorder"]


class Recorder:
    """Appends records to one file, which it begins or goes on with. For one thread.

    A record is with the operating system when `record` returns: it outlives the process, however that ends. Power
    failure may cost what came after the last fsync: one is made every `fsync_every` records (None: none) and on close,
    and takes the storage's time, often milliseconds.
    """

    def __init__(self, path: Path, header: Header, *, fsync_every: int | None = 600) -> None:
        """Begin the file, or go on with one of the same header: its torn tail is cut off, a new session begins.

        The file is read through once. Raises RecordingError where it is something else, has another header, or is
        damaged before a whole record (nothing is changed then); BlockingIOError while another recorder has it (where
        the system has flock); ProtocolError for a header that cannot be written; OSError.
        """
        if fsync_every is not None and fsync_every < 1:
            raise ValueError(f"fsync_every is {fsync_every}, expected at least 1, or None")
        self.path, self.header = path, header
        self.cut_bytes = 0
        """How long the torn tail was."""
        self._fsync_every, self._unsynced = fsync_every, 0
        self._open, self._session = OpenEpisodes(), 0
        begin = encode_header(header)
        self._file = path.open("a+b", buffering=0)
        try:
            _lock(self._file.fileno(), path)
            if self._holds_less_than(begin):
                self._begin(begin)
            else:
                self._go_on()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def record(
        self,
        episodes: Sequence[int] | NDArray[np.integer],
        frame: int,
        *,
        free: ArrayLike,
        costly: ArrayLike,
        actions: ArrayLike,
        acquired: ArrayLike | None = None,
        rewards: ArrayLike | None = None,
        terminated: ArrayLike | None = None,
        truncated: ArrayLike | None = None,
    ) -> None:
        """Append one frame of the bots that play these episodes, N different ids of the engine's choice.

        `free` [N, F] and `costly` [N, D] as seen in this frame, `actions` [N, A] as then decided, `rewards` [N] since
        each bot's record before (None: none), `acquired` bool [N, M] (None: all). `terminated` or `truncated` bool [N]
        marks the last record of an episode. Costly numbers that were not acquired and actions of ended episodes are
        not looked at.

        Raises BadSchema, BadShape, NonFinite, OutOfRange, StaleFrame, TooManyBots and TooLarge; nothing has changed
        then, and rewards that were to be recorded belong in the bots' next record. Raises OSError where the record
        could not be written, on a full disk for one: the file ends with the record before, or with this one where it
        could only not be synced, and the recorder is closed, so that no episode has a hole. Raises RecordingError when
        closed.
        """
        if self._file.closed:
            raise RecordingError(f"{self.path}: the recorder is closed")
        record = checked_record(
            self.header,
            self._session,
            frame,
            episodes,
            free=free,
            costly=costly,
            actions=actions,
            acquired=acquired,
            rewards=rewards,
            terminated=terminated,
            truncated=truncated,
        )
        self._open.check(record)
        self._append(record)

    def close(self) -> None:
        """Sync and close the file; a second time does nothing. Raises OSError, and is closed then too."""
        if not self._file.closed:
            with self._file:
                if self._unsynced:
                    os.fsync(self._file.fileno())

    def _append(self, record: Record) -> None:
        block, size = encode_record(record, self.header), self._size()
        try:
            self._write(block)
            self._open.advance(record)
        except BaseException:  # a half-written record, or an interrupt after which nobody could tell
            with self._file:
                self._file.truncate(size)
            raise
        self._unsynced += 1
        if self._unsynced == self._fsync_every:
            self._sync()

    def _write(self, data: bytes) -> None:
        """One write; what a full disk did not take of it is tried again, for the system's word on why."""
        done = 0
        while done < len(data):
            done += self._file.write(data[done:])

    def _sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except OSError:
            self._file.close()
            raise
        self._unsynced = 0

    def _size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    def _holds_less_than(self, begin: bytes) -> bool:
        """Whether the file is new, or was left while its header was being written."""
        size = self._size()
        self._file.seek(0)
        return size < len(begin) and self._file.read(len(begin)) == begin[:size]

    def _begin(self, header: bytes) -> None:
        self._file.truncate(0)
        self._write(header)
        self._sync()
        if sys.platform != "win32":  # a new name must outlive a power failure too
            folder = os.open(self.path.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)

    def _go_on(self) -> None:
        recording = read_recording(self.path)
        for name in ("features", "action", "about"):
            if getattr(recording.header, name) != getattr(self.header, name):
                raise RecordingError(f"{self.path} was begun with another {name!r}: record into another file")
        for record in recording:
            self._session = record.session + 1
        if self._session > MAX_FRAME:
            raise RecordingError(f"{self.path} has had {self._session} sessions, expected {MAX_FRAME} or less")
        tail = recording.tail
        if tail.resumes_at is not None:
            raise RecordingError(
                f"{self.path} is damaged: no record at byte {tail.offset} ({tail.reason}), but maybe one at byte"
                f" {tail.resumes_at}: record into another file"
            )
        self.cut_bytes = tail.left_out
        self._file.truncate(tail.offset)


def _lock(descriptor: int, path: Path) -> None:
    if sys.platform == "win32":
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise BlockingIOError(errno.EWOULDBLOCK, "another recorder has this file", str(path)) from error
