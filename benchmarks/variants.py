"""Another version of a bundle: the same features, action and sizes, other weights, so that it does other things.

This module knows nothing about what the versions are for. A variant passes verification like any bundle; as a player it
is worse than what it was made from.
"""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import msgspec
import numpy as np
import onnx
from onnx import numpy_helper

from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.golden import Golden, read_golden
from bot_runtime.manifest import FILES
from bot_runtime.policy import Policy

__all__ = ["write_variant"]

_BOT = np.zeros(1, dtype=np.int64)
_SHAKEN = 0.3  # of each matrix's standard deviation


def write_variant(bundle: Path, path: Path, *, name: str, seed: int) -> Path:
    """Write a variant of the bundle in `bundle` to the new folder `path`, under this name. Seed 0 shakes nothing."""
    shutil.copytree(bundle, path)
    for graph in ("acquisition.onnx", "action.onnx"):
        (path / graph).write_bytes(_shaken((path / graph).read_bytes(), seed))
    manifest = msgspec.json.decode((path / "manifest.json").read_bytes()) | {"name": name}
    _seal(path, manifest)
    shaken = Bundle.load(path, replay=False)
    golden = read_golden((path / "golden.npz").read_bytes(), shaken.manifest)
    np.savez(path / "golden.npz", **_replayed(shaken, golden))
    _seal(path, manifest)
    return path


def _shaken(graph: bytes, seed: int) -> bytes:
    model, random = onnx.load_from_string(graph), np.random.default_rng(seed)
    for tensor in model.graph.initializer:
        weights = numpy_helper.to_array(tensor)
        if seed and weights.dtype == np.float32 and weights.ndim >= 2:
            noise = random.normal(0.0, _SHAKEN * float(weights.std()), weights.shape)
            shaken = weights + noise * (weights != 0.0)  # zeros are there for what must not be read
            tensor.CopyFrom(numpy_helper.from_array(shaken.astype(np.float32), tensor.name))
    return bytes(model.SerializeToString())


def _replayed(bundle: Bundle, golden: Golden) -> Golden:
    """The golden episode with these weights: the same inputs and queries, what comes out now."""
    manifest, policy = bundle.manifest, Policy(bundle)
    contexts = Contexts(manifest, 1)
    contexts.begin(_BOT, golden["seed"].astype(np.uint64).reshape(1), np.zeros(1))
    batch, known = contexts.batch(_BOT), golden["queries"].astype(np.bool_)
    left = golden["target_return"].astype(np.float64) - np.cumsum(golden["rewards"].astype(np.float64))
    batch.target_cost_N1[:] = golden.get("target_cost", 0.0)
    replayed = dict(golden)
    for turn, query_M in enumerate(known):
        batch.free_NF[:], batch.left_N1[:] = golden["free"][turn], left[turn]
        policy.query_probs(batch)
        replayed["probs"][turn] = batch.probs_NM[0]  # the action graph writes over it
        batch.keep_prepared()
        batch.query_NM[:] = query_M
        batch.costly_ND[:] = np.where(query_M[manifest.features.owner], golden["costly"][turn], 0.0)
        if manifest.samples_action:
            batch.noise_NA[:] = contexts.noise(batch)[:, manifest.features.n_queries :]
        policy.act(batch)
        outputs = {"actions": batch.action_NA, "hidden": batch.hidden_NW}
        for output in outputs.keys() & golden.keys():
            replayed[output][turn] = outputs[output][0]
        contexts.advance(batch, batch.action_NA)
    return replayed


def _seal(path: Path, manifest: dict[str, object]) -> None:
    """Write the manifest with the sizes and hashes that the files now have."""
    contents = {file: (path / file).read_bytes() for file in FILES}
    files = {file: {"sha256": hashlib.sha256(c).hexdigest(), "bytes": len(c)} for file, c in contents.items()}
    (path / "manifest.json").write_bytes(msgspec.json.encode({**manifest, "files": files}))
