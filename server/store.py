"""The store: a folder of bundles by name and version, and which version of each was made active last.

This module knows nothing about what is in memory. `STORE/NAME/VERSION/` holds a bundle, VERSION a whole number from 1,
written once and never changed; `STORE/NAME/active.json` is the record that survives a restart. Anything of another name
is ignored, so that a bundle can be copied beside the versions and renamed when it is whole.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import msgspec

from bot_runtime.contents import MANIFEST_FILE, MAX_MANIFEST_BYTES, read_file
from protocol.errors import BadBundle, NoBundle

__all__ = ["MAX_VERSIONS", "Content", "Record", "Store"]

MAX_VERSIONS = 1000  # of one name: a listing has them all
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
_VERSION = re.compile(r"[1-9][0-9]{0,8}")
_RECORD_FILE = "active.json"
_MAX_RECORD_BYTES = 4096


class Content(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A version, and the SHA-256 of the manifest that it had when it was activated."""

    version: int
    sha256: str


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is active, and what was before it and can be rolled back to."""

    active: Content
    previous: Content | None = None


class Store:
    """Reads the folder anew each time: versions may come while the server runs. Blocks on the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def names(self) -> list[str]:
        """The names there are, in order; raises OSError where there is no such folder."""
        found = (entry.name for entry in os.scandir(self._folder) if entry.is_dir(follow_symlinks=False))
        return sorted(name for name in found if _NAME.fullmatch(name))

    def versions(self, name: str) -> list[int]:
        """The versions of a name in order; raises NoBundle, and BadBundle where there are more than MAX_VERSIONS."""
        found = (entry.name for entry in os.scandir(self._of(name)) if entry.is_dir(follow_symlinks=False))
        versions = sorted(int(version) for version in found if _VERSION.fullmatch(version))
        if len(versions) > MAX_VERSIONS:
            raise BadBundle(f"{name} has {len(versions)} versions in the store, expected at most {MAX_VERSIONS}")
        return versions

    def path(self, name: str, version: int) -> Path:
        """The folder of this version; raises NoBundle."""
        path = self._of(name) / str(version)
        if not _VERSION.fullmatch(str(version)) or not _is_folder(path):
            raise NoBundle(f"no version {version} of {name} is in the store")
        return path

    def sha256(self, name: str, version: int) -> str:
        """The hash of a version's manifest as it is on disk, unverified; raises NoBundle, BadBundle."""
        content = read_file(self.path(name, version) / MANIFEST_FILE, MAX_MANIFEST_BYTES)
        return hashlib.sha256(content).hexdigest()

    def record(self, name: str) -> Record | None:
        """What was recorded last; None where nothing ever was. Raises NoBundle, BadBundle where it cannot be read."""
        path = self._of(name) / _RECORD_FILE
        if not os.path.lexists(path):
            return None
        try:
            return msgspec.json.decode(read_file(path, _MAX_RECORD_BYTES), type=Record)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            raise BadBundle(f"{path} is damaged: {error}. Remove it to begin with the highest version") from error

    def write(self, name: str, record: Record | None) -> None:
        """Record this, whole or not at all, also if the machine loses power meanwhile. Raises NoBundle, OSError."""
        folder = self._of(name)
        if record is None:
            (folder / _RECORD_FILE).unlink(missing_ok=True)
            return
        unfinished = folder / f"{_RECORD_FILE}.{os.getpid()}"
        with unfinished.open("wb") as file:
            file.write(msgspec.json.encode(record) + b"\n")
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(folder / _RECORD_FILE)
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)  # the new name too
        finally:
            os.close(descriptor)

    def _of(self, name: str) -> Path:
        """The folder of a name, which never leads out of the store."""
        path = self._folder / name
        if not _NAME.fullmatch(name) or not _is_folder(path):
            raise NoBundle(f"no bundle {name[:80]!r} is in the store")
        return path


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()
