"""A bundle on disk becomes a verified bundle in memory, or BadBundle.

This module knows nothing about bots, turns or servers. Hashes guard against damage, not against an author: whoever can
write the manifest can write matching hashes. What stands against a hostile author is that nothing in a bundle is code
(no pickle, no custom operator, no reference to another file), that sizes are bounded, and that the graphs may hold
only allowed operators.
"""

from __future__ import annotations

import hashlib
import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bot_runtime.golden import read_golden, replay
from bot_runtime.graph import check_graph
from bot_runtime.manifest import FILES, SCHEMA_VERSION, FileEntry, Manifest
from bot_runtime.policy import Policy
from protocol.errors import BadBundle

__all__ = ["MANIFEST_FILE", "MAX_FILE_BYTES", "MAX_MANIFEST_BYTES", "MAX_TURN_MS", "Bundle"]

MANIFEST_FILE = "manifest.json"
MAX_MANIFEST_BYTES = 2**20
MAX_FILE_BYTES = 256 * 2**20
MAX_TURN_MS = 100.0  # a frame is 16: what takes longer than this, at its fastest, can serve nobody
_PROBE_BOTS = 3
_PROBE_TURNS = 5  # a busy machine may stretch some of them


class _Version(msgspec.Struct):
    """What every schema of a manifest has."""

    schema_version: int


@dataclass(frozen=True)
class Bundle:
    """The manifest and the verified bytes of both graphs. Nothing is read from disk after `load`.

    `sha256` is of the manifest, which has the hashes of the other files: it names the whole content.
    """

    manifest: Manifest
    acquisition: bytes
    action: bytes
    sha256: str

    @property
    def name(self) -> str:
        """The manifest's name."""
        return self.manifest.name

    @classmethod
    def load(cls, path: Path, *, replay: bool = True, clock: Callable[[], int] = time.perf_counter_ns) -> Bundle:
        """Read and verify the bundle in directory `path`. Other files there are ignored.

        In this order, each step only on what passed the one before: regular files and not links, sizes, the manifest's
        schema, sizes and SHA-256 of the three files, operators, the graphs' inputs and outputs, a batch of bots, how
        long their turn takes (`clock` counts ns), and (unless `replay` is false) the golden episode. Raises BadBundle
        naming the file, what was expected and what was found.
        """
        read = _read(path / MANIFEST_FILE, MAX_MANIFEST_BYTES)
        manifest = _read_manifest(read)
        contents = {file: _read_verified(path / file, manifest.files[file]) for file in FILES}
        bundle = cls(manifest, contents["acquisition.onnx"], contents["action.onnx"], hashlib.sha256(read).hexdigest())
        check_graph("acquisition.onnx", bundle.acquisition)
        check_graph("action.onnx", bundle.action)
        _verify_behaviour(bundle, contents["golden.npz"], with_replay=replay, clock=clock)
        return bundle


def _read_manifest(content: bytes) -> Manifest:
    try:
        version = msgspec.json.decode(content, type=_Version).schema_version
        if version != SCHEMA_VERSION:
            expected = f"expected {SCHEMA_VERSION}: export the run again"
            raise BadBundle(f"{MANIFEST_FILE} has schema_version {version}, {expected}")
        return msgspec.json.decode(content, type=Manifest)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadBundle(f"{MANIFEST_FILE}: {error}") from error


def _read_verified(path: Path, entry: FileEntry) -> bytes:
    content = _read(path, MAX_FILE_BYTES)
    if len(content) != entry.bytes:
        raise BadBundle(f"{path.name} has {len(content)} bytes, the manifest says {entry.bytes}")
    digest = hashlib.sha256(content).hexdigest()
    if digest != entry.sha256:
        raise BadBundle(f"{path.name} has sha256 {digest}, the manifest says {entry.sha256}")
    return content


def _read(path: Path, limit: int) -> bytes:
    """The whole content of a regular file. Opening never follows a link at `path` and never waits for a pipe."""
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


def _verify_behaviour(bundle: Bundle, golden: bytes, *, with_replay: bool, clock: Callable[[], int]) -> None:
    recorded = read_golden(golden, bundle.manifest)
    policy = Policy(bundle)
    try:
        _probe_latency(policy, bundle.manifest, clock)
        if with_replay:
            replay(policy, bundle.manifest, recorded)
    except BadBundle:
        raise
    except Exception as error:  # onnxruntime raises a dozen unrelated types for a graph that cannot run
        raise BadBundle(f"the graphs of {bundle.name} do not run: {str(error)[:300]}") from error


def _probe_latency(policy: Policy, manifest: Manifest, clock: Callable[[], int]) -> None:
    for _ in range(_PROBE_TURNS):
        started_ns = clock()
        policy.check_batch(_PROBE_BOTS)
        turn_ms = (clock() - started_ns) / 1e6
        if turn_ms <= MAX_TURN_MS:
            return
    raise BadBundle(f"a turn of {manifest.name} takes {turn_ms:.0f} ms, expected at most {MAX_TURN_MS:g}")
