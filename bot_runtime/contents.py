"""A bundle's files become bytes that are proven to be those its manifest names, or BadBundle.

This module knows nothing about what is in a graph: nothing but the manifest is parsed here. Hashes guard against
damage, not against an author: whoever can write the manifest can write matching hashes. Against an author stands a
signature of the manifest (`bot_runtime.signature`), which is checked before even that is parsed.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self

import msgspec

from bot_runtime.manifest import FILES, SCHEMA_VERSION, FileEntry, Manifest
from protocol.errors import BadBundle

if TYPE_CHECKING:  # who checks no signatures needs no cryptography
    from bot_runtime.signature import Keys

__all__ = [
    "MANIFEST_FILE",
    "MAX_FILE_BYTES",
    "MAX_MANIFEST_BYTES",
    "SIGNATURE_FILE",
    "Contents",
    "read_file",
    "read_manifest",
]

MANIFEST_FILE = "manifest.json"
SIGNATURE_FILE = "manifest.sig"
MAX_MANIFEST_BYTES = 2**20
MAX_FILE_BYTES = 256 * 2**20
_MAX_SIGNATURE_BYTES = 1024


class _Version(msgspec.Struct):
    """What every schema of a manifest has."""

    schema_version: int


class Contents(NamedTuple):
    """The manifest and its bytes, their SHA-256, who signed them (None: not asked), and each other file's bytes."""

    manifest: Manifest
    manifest_json: bytes
    sha256: str
    signed_by: str | None
    files: dict[str, bytes]

    @classmethod
    def read(cls, path: Path, keys: Keys | None = None) -> Self:
        """Read the bundle in directory `path`; other files there are ignored.

        In this order, each step only on what passed the one before: the manifest's size, its signature by one of `keys`
        if there are any, its schema, sizes and SHA-256 of the other files. Raises BadBundle.
        """
        content = read_file(path / MANIFEST_FILE, MAX_MANIFEST_BYTES)
        signed_by = None
        if keys is not None:
            signed_by = keys.signer(content, read_file(path / SIGNATURE_FILE, _MAX_SIGNATURE_BYTES))
        manifest = read_manifest(content)
        files = {file: _read_verified(path / file, manifest.files[file]) for file in FILES}
        return cls(manifest, content, hashlib.sha256(content).hexdigest(), signed_by, files)


def read_manifest(content: bytes) -> Manifest:
    """The manifest in these bytes; raises BadBundle."""
    try:
        version = msgspec.json.decode(content, type=_Version).schema_version
        if version != SCHEMA_VERSION:
            expected = f"expected {SCHEMA_VERSION}: export the run again"
            raise BadBundle(f"{MANIFEST_FILE} has schema_version {version}, {expected}")
        return msgspec.json.decode(content, type=Manifest)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise BadBundle(f"{MANIFEST_FILE}: {error}") from error


def read_file(path: Path, limit: int) -> bytes:
    """The whole content of a regular file of at most `limit` bytes. Raises BadBundle.

    Opening never follows a link at `path` and never waits for a pipe.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BadBundle(f"{path.name} cannot be opened, expected a regular file: {error.strerror}") from error
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise BadBundle(f"{path.name} is not a regular file")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            content = file.read(limit + 1)
    finally:
        os.close(descriptor)
    if len(content) > limit:
        raise BadBundle(f"{path.name} has more than {limit} bytes")
    return content


def _read_verified(path: Path, entry: FileEntry) -> bytes:
    content = read_file(path, MAX_FILE_BYTES)
    if len(content) != entry.bytes:
        raise BadBundle(f"{path.name} has {len(content)} bytes, the manifest says {entry.bytes}")
    digest = hashlib.sha256(content).hexdigest()
    if digest != entry.sha256:
        raise BadBundle(f"{path.name} has sha256 {digest}, the manifest says {entry.sha256}")
    return content
