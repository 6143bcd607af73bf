"""Tiny bundles with random weights that obey the bundle contract: real ONNX, real causal attention, a real golden file.

Every output depends on every input, so that tests of context, masking, slots and noise can fail.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime as ort

from bot_runtime.manifest import FILES, SCHEMA_VERSION, FileEntry, Manifest
from bot_runtime.noise import uniforms
from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable
from tests.graphs import acquisition_graph, action_graph

__all__ = ["ACTION", "FEATURES", "make_bundle", "rehash"]

FEATURES = FeatureTable(
    (
        Feature("position", 3, 0.0, -100.0, 100.0),
        Feature("ray_near", 2, 1.25, 0.0, 1.0),
        Feature("goal", 2, 0.0, -1.0, 1.0),
        Feature("ray_mid", 1, 2.5, -5.0, 5.0),
        Feature("ray_far", 3, 7.1, 0.0, 50.0),
        Feature("ray_farther", 1, 11.3, 0.0, 1.0),
        Feature("sound", 2, 0.3),
    )
)
ACTION = ActionSpec(
    (ActionComponent("turn", -1.0, 1.0), ActionComponent("forward", 0.0, 1.0, 0.5), ActionComponent("jump", 0.0, 1.0))
)


def make_bundle(
    path: Path,
    *,
    features: FeatureTable | None = None,
    action: ActionSpec | None = None,
    context_length: int = 4,
    n_layers: int = 2,
    n_heads: int = 2,
    n_kv_heads: int | None = None,
    head_dim: int = 8,
    seed: int = 0,
    name: str = "tiny",
    budget: float = 0.5,
    target_return: float = 10.0,
    method: str = "bdt",
    target_cost: float | None = None,
    prepared_width: int = 6,
    samples_action: bool = True,
) -> Path:
    """Write a bundle into directory `path` (made if missing) and return it. The width is n_heads * head_dim.

    With `context_length` 1 it has no memory, and no layers or heads whatever is asked for. A `target_cost` makes it a
    bundle that is conditioned on its budget.
    """
    if context_length == 1:
        n_layers = n_heads = head_dim = 0
        n_kv_heads = None
    path.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(
        schema_version=SCHEMA_VERSION,
        name=name,
        method=method,
        features=features or FEATURES,
        action=action or ACTION,
        context_length=context_length,
        n_layers=n_layers,
        n_heads=n_heads,
        head_dim=head_dim,
        width=n_heads * head_dim,
        prepared_width=prepared_width,
        samples_action=samples_action,
        target_return=target_return,
        budget=budget,
        tolerance=1e-4,
        files={file: FileEntry("0" * 64, 1) for file in FILES},
        provenance={"made_by": "tests/bundles.py"},
        target_cost=target_cost,
        n_kv_heads=n_kv_heads,
    )
    (path / "acquisition.onnx").write_bytes(acquisition_graph(manifest, seed))
    (path / "action.onnx").write_bytes(action_graph(manifest, seed + 1))
    np.savez(path / "golden.npz", **_golden(path, manifest, seed))
    (path / "manifest.json").write_bytes(msgspec.json.encode(manifest))
    return rehash(path)


def rehash(path: Path) -> Path:
    """Make the manifest's sizes and hashes true again after a test has changed a file."""
    manifest = msgspec.json.decode((path / "manifest.json").read_bytes())
    for file in FILES:
        content = (path / file).read_bytes()
        manifest["files"][file] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    (path / "manifest.json").write_bytes(msgspec.json.encode(manifest))
    return path


def _golden(path: Path, manifest: Manifest, seed: int) -> dict[str, np.ndarray]:
    """Record an episode with plain sessions and a cache kept as a list: no ring, no arena, no Policy."""
    table = manifest.features
    random, turns, noise_seed = np.random.default_rng(seed), 3 * manifest.context_length + 2, np.uint64(seed + 12345)
    head, trunk = (ort.InferenceSession(path / f"{graph}.onnx") for graph in ("acquisition", "action"))

    def draw(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return random.uniform(np.maximum(low, -2.0), np.minimum(high, 2.0), (turns, low.size)).astype(np.float32)

    free, costly = draw(*table.free_range), draw(*table.costly_range)
    rewards = np.concatenate([[0.0], random.normal(0.5, 0.3, turns - 1)]).astype(np.float32)
    asked = {"target_cost": np.float32([[manifest.target_cost]])} if manifest.is_conditioned else {}
    hidden, past, rows = np.zeros((1, manifest.width), dtype=np.float32), [], []
    for turn in range(turns):
        left = np.array([[manifest.target_return - rewards[: turn + 1].sum(dtype=np.float64)]], dtype=np.float32)
        before = np.concatenate([hidden, free[turn : turn + 1], left], axis=1)
        probs, prepared = head.run(["query_probs", "prepared"], {"before": before} | asked)
        noise = uniforms(np.array([noise_seed]), np.array([turn]), table.n_queries + manifest.action.size)
        query = noise[:, : table.n_queries] < probs
        known = costly[turn : turn + 1] * query[:, table.owner]
        feed = {"prepared": prepared, "acquired": np.concatenate([known, query], axis=1).astype(np.float32)}
        feed |= {"noise": noise[:, table.n_queries :]} if manifest.samples_action else {}
        feed |= _cache(manifest, past)
        action, *memory = trunk.run(None, feed)
        row = {"probs": probs[0], "queries": query[0].astype(np.uint8), "actions": action[0]}
        if manifest.has_context:
            hidden, *tokens = memory  # a key and a value of each layer
            past.append([token[:, :, :, 0] for token in tokens])
            row["hidden"] = hidden[0]
        rows.append(row)
    outputs = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    scalars = {"seed": noise_seed, "target_return": np.float64(manifest.target_return)}
    scalars |= {name: number[0, 0] for name, number in asked.items()}
    return {"free": free, "costly": costly, "rewards": rewards, **outputs, **scalars}


def _cache(manifest: Manifest, past: list[list[np.ndarray]]) -> dict[str, np.ndarray]:
    """The inputs that hold these turns, the oldest first, each in the slot of its turn."""
    if not manifest.has_context:
        return {}
    slots, turn = manifest.n_slots, len(past)
    feed = {"place": np.array([turn if turn < slots else slots + turn % slots])}
    for layer in range(manifest.n_layers):
        for kind, name in enumerate(("key", "value")):
            heads, head = manifest.token
            ring = np.zeros((1, 1, heads, slots, head), dtype=np.float32)
            for t in range(max(0, turn - slots), turn):
                ring[:, :, :, t % slots] = past[t][2 * layer + kind]
            feed[f"{name}s_{layer}"] = ring
    return feed
