"""What an engine needs to run the head of the bundle that a server serves, fetched from that server.

This module knows nothing about running it (`bot_runtime.head` does), nor about messages.

    bots = client.start(2, seeds=[7, 8])
    files = HeadFiles.fetch("http://127.0.0.1:8000", client.welcome.bundle_sha256)  # of the version that they are of
    head = Head(files.manifest, files.acquisition, seeds=[7, 8])
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple, Self

from bot_runtime.contents import MANIFEST_FILE, MAX_FILE_BYTES, MAX_MANIFEST_BYTES, read_manifest
from bot_runtime.graph import check_graph
from bot_runtime.manifest import Manifest
from protocol.errors import BadBundle
from protocol.fetching import fetch

__all__ = ["HeadFiles"]

_ACQUISITION_FILE = "acquisition.onnx"


class HeadFiles(NamedTuple):
    """A manifest, and the bytes of the acquisition graph that it names."""

    manifest: Manifest
    acquisition: bytes

    @classmethod
    def fetch(
        cls, url: str, sha256: str, *, token: str | None = None, timeout_s: float = 5.0, cafile: Path | None = None
    ) -> Self:
        """Those of the bundle whose `welcome` named this `bundle_sha256`, from the server's HTTP door at `url`.

        Whatever the server sends, what comes back is what the hash names. Raises BadBundle where it is not, NoBundle
        where no connection holds that bundle any more, and as `protocol.fetching.fetch`.
        """

        def file(name: str, limit: int) -> bytes:
            return fetch(url, f"/v1/bundles/{sha256}/{name}", limit, token=token, timeout_s=timeout_s, cafile=cafile)

        content = file(MANIFEST_FILE, MAX_MANIFEST_BYTES)
        _check_hash(MANIFEST_FILE, content, sha256)
        manifest = read_manifest(content)
        entry = manifest.files[_ACQUISITION_FILE]
        graph = file(_ACQUISITION_FILE, min(entry.bytes, MAX_FILE_BYTES))
        _check_hash(_ACQUISITION_FILE, graph, entry.sha256)
        check_graph(_ACQUISITION_FILE, graph)
        return cls(manifest, graph)


def _check_hash(name: str, content: bytes, expected: str) -> None:
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise BadBundle(f"{name} has sha256 {found}, expected {expected}")
