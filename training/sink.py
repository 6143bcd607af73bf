"""A file that HDF5 writes to, and what the disk said to that.

libhdf5 does not survive a disk that is full: what it could not write it cannot close either, and the process ends in a
segmentation fault, after thousands of tracebacks. So it is told that all is well, and whoever had it write asks here.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

__all__ = ["Sink"]


class Sink(io.RawIOBase):
    """A new file for `h5py.File`. After the first write that fails no other is tried, and what is not there reads as
    zeros."""

    def __init__(self, path: Path) -> None:
        """Raises OSError."""
        self._error: OSError | None = None
        self._file = path.open("x+b", buffering=0)

    def check(self) -> None:
        """Raises the OSError of the first write that failed, for instance for a full disk."""
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        self._file.close()
        super().close()

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: Any) -> int | None:
        read = self._file.readinto(buffer)
        if self._error is None or read is None:
            return read
        view = memoryview(buffer)
        view[read:] = bytes(len(view) - read)
        return len(view)

    def write(self, data: Any) -> int:
        rest = memoryview(data)
        size = len(rest)
        try:
            while rest and self._error is None:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            if self._error is None:
                return self._file.truncate(size)
        except OSError as error:
            self._error = error
        return self._file.tell() if size is None else size
