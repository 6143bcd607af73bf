"""A bundle's folder while it is written: it takes its place whole, or not at all.

This module knows nothing about networks or what the files hold.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from bot_runtime.contents import MANIFEST_FILE
from bot_runtime.manifest import FILES, FileEntry, Manifest

__all__ = ["file_entries", "new_folder", "write_manifest"]


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """An empty folder that replaces `out` when the block ends without an exception; else nothing changes.

    Raises ValueError where `out` holds other things than a bundle, which nobody wants replaced.
    """
    if out.exists() and not (out / MANIFEST_FILE).is_file() and not (out.is_dir() and not any(out.iterdir())):
        raise ValueError(f"{out} is there and is no bundle, expected a new folder or a bundle to replace")
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".export-") as scratch:
        folder = Path(scratch) / out.name
        folder.mkdir()
        yield folder
        if out.exists():
            shutil.rmtree(out)
        os.replace(folder, out)


def file_entries(folder: Path) -> dict[str, FileEntry]:
    """Size and hash of each file that a manifest names."""
    contents = {name: (folder / name).read_bytes() for name in FILES}
    return {name: FileEntry(hashlib.sha256(data).hexdigest(), len(data)) for name, data in contents.items()}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write manifest.json, for people too."""
    (folder / MANIFEST_FILE).write_bytes(msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
