"""A bundle on disk becomes a verified bundle in memory, or BadBundle.

This module knows nothing about bots, turns or servers. What stands against a hostile author is that nothing in a bundle
is code (no pickle, no custom operator, no reference to another file), that sizes are bounded, and that the graphs may
hold only allowed operators; and a signature, where one is asked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bot_runtime.contents import Contents
from bot_runtime.golden import read_golden, replay
from bot_runtime.graph import check_graph
from bot_runtime.manifest import Manifest
from bot_runtime.policy import Policy
from protocol.errors import BadBundle

if TYPE_CHECKING:
    from bot_runtime.signature import Keys

__all__ = ["MAX_TURN_MS", "Bundle"]

MAX_TURN_MS = 100.0  # a frame is 16: what takes longer than this, at its fastest, can serve nobody
_PROBE_BOTS = 3
_PROBE_TURNS = 5  # a busy machine may stretch some of them


@dataclass(frozen=True)
class Bundle:
    """The manifest and the verified bytes of both graphs. Nothing is read from disk after `load`.

    `sha256` is of the manifest, which has the hashes of the other files: it names the whole content. `signed_by` is the
    fingerprint of the key that signed it, None where no signature was asked for. `manifest_json` is what was hashed,
    for whoever wants to check it.
    """

    manifest: Manifest
    acquisition: bytes
    action: bytes
    sha256: str
    signed_by: str | None = None
    manifest_json: bytes = b""

    @property
    def name(self) -> str:
        """The manifest's name."""
        return self.manifest.name

    @classmethod
    def load(
        cls,
        path: Path,
        *,
        replay: bool = True,
        clock: Callable[[], int] = time.perf_counter_ns,
        keys: Keys | None = None,
    ) -> Bundle:
        """Read and verify the bundle in directory `path`. Other files there are ignored.

        In this order, each step only on what passed the one before: regular files and not links, sizes, the signature
        by one of `keys` if there are any, the manifest's schema, sizes and SHA-256 of the three files, operators, the
        graphs' inputs and outputs, a batch of bots, how long their turn takes (`clock` counts ns), and (unless `replay`
        is false) the golden episode. Raises BadBundle naming the file, what was expected and what was found.
        """
        contents = Contents.read(path, keys)
        bundle = cls._of(contents)
        check_graph("acquisition.onnx", bundle.acquisition)
        check_graph("action.onnx", bundle.action)
        _verify_behaviour(bundle, contents.files["golden.npz"], with_replay=replay, clock=clock)
        return bundle

    @classmethod
    def read(cls, path: Path, *, keys: Keys | None = None) -> Bundle:
        """The same without looking into the graphs: for a content (`sha256`) that `load` has verified before."""
        return cls._of(Contents.read(path, keys))

    @classmethod
    def _of(cls, contents: Contents) -> Bundle:
        graphs = contents.files["acquisition.onnx"], contents.files["action.onnx"]
        return cls(contents.manifest, *graphs, contents.sha256, contents.signed_by, contents.manifest_json)


def _verify_behaviour(bundle: Bundle, golden: bytes, *, with_replay: bool, clock: Callable[[], int]) -> None:
    recorded = read_golden(golden, bundle.manifest)
    policy = Policy(bundle)
    try:
        _probe_latency(policy, bundle.manifest, clock)
        policy.check_prepared()
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
