"""Tiny bundles with random weights that obey the bundle contract: real ONNX, real causal attention, a real golden file.

Every output depends on every input, so that tests of context, masking, slots and noise can fail.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
import numpy as np
import onnx
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper

from bot_runtime.manifest import FILES, FileEntry, Manifest
from bot_runtime.noise import uniforms
from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable

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
_OPSET = 17
_IR_VERSION = 9
_MASKED = -1e9


class _Graph:
    """Collects nodes and random initializers."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.nodes: list[onnx.NodeProto] = []
        self.initializers: list[onnx.TensorProto] = []

    def constant(self, array: np.ndarray) -> str:
        name = f"c{len(self.initializers)}"
        self.initializers.append(numpy_helper.from_array(array, name))
        return name

    def ints(self, *numbers: int) -> str:
        return self.constant(np.array(numbers, dtype=np.int64))

    def op(self, op: str, *inputs: str, out: str | None = None, **attributes: object) -> str:
        name = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [name], **attributes))
        return name

    def linear(self, x: str, rows: int, columns: int, out: str | None = None) -> str:
        weight = self.random.normal(0.0, 1.5 / np.sqrt(rows), (rows, columns)).astype(np.float32)
        bias = self.random.normal(0.0, 0.3, columns).astype(np.float32)
        return self.op("Add", self.op("MatMul", x, self.constant(weight)), self.constant(bias), out=out)

    def scaled(self, x: str, columns: int, scale: np.ndarray | float) -> str:
        return self.op("Mul", x, self.constant(np.broadcast_to(np.float32(scale), (columns,)).copy()))

    def model(self, inputs: dict[str, tuple], outputs: dict[str, tuple]) -> bytes:
        def ports(shapes: dict[str, tuple]) -> list[onnx.ValueInfoProto]:
            kinds = {"ages": TensorProto.INT64}
            return [helper.make_tensor_value_info(n, kinds.get(n, TensorProto.FLOAT), s) for n, s in shapes.items()]

        graph = helper.make_graph(self.nodes, "tiny", ports(inputs), ports(outputs), self.initializers)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString()


def make_bundle(
    path: Path,
    *,
    features: FeatureTable | None = None,
    action: ActionSpec | None = None,
    context_length: int = 4,
    n_layers: int = 2,
    n_heads: int = 2,
    head_dim: int = 8,
    seed: int = 0,
    name: str = "tiny",
    budget: float = 0.5,
    target_return: float = 10.0,
) -> Path:
    """Write a bundle into directory `path` (made if missing) and return it. The width is n_heads * head_dim."""
    path.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(
        schema_version=1,
        name=name,
        method="bdt",
        features=features or FEATURES,
        action=action or ACTION,
        context_length=context_length,
        n_layers=n_layers,
        n_heads=n_heads,
        head_dim=head_dim,
        width=n_heads * head_dim,
        target_return=target_return,
        budget=budget,
        tolerance=1e-4,
        files={file: FileEntry("0" * 64, 1) for file in FILES},
        provenance={"made_by": "tests/bundles.py"},
    )
    (path / "acquisition.onnx").write_bytes(_acquisition(manifest, seed))
    (path / "action.onnx").write_bytes(_action(manifest, seed + 1))
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


def _acquisition(manifest: Manifest, seed: int) -> bytes:
    table, width = manifest.features, manifest.width
    graph = _Graph(seed)
    free = graph.scaled("free", table.n_free, 1.0 / np.maximum(np.abs(table.free_range[1]), 1.0))
    x = graph.op("Concat", "hidden", free, graph.scaled("returns_to_go", 1, 0.1), axis=1)
    x = graph.op("Tanh", graph.linear(x, width + table.n_free + 1, width))
    graph.op("Sigmoid", graph.linear(x, width, table.n_queries), out="query_probs")
    inputs = {"hidden": ("N", width), "free": ("N", table.n_free), "returns_to_go": ("N", 1)}
    return graph.model(inputs, {"query_probs": ("N", table.n_queries)})


def _action(manifest: Manifest, seed: int) -> bytes:
    table, spec, width = manifest.features, manifest.action, manifest.width
    layers, heads, slots, dim = manifest.n_layers, manifest.n_heads, manifest.n_slots, manifest.head_dim
    graph = _Graph(seed)
    free = graph.scaled("free", table.n_free, 1.0 / np.maximum(np.abs(table.free_range[1]), 1.0))
    costly = graph.scaled("costly", table.n_costly, 1.0 / np.clip(np.abs(table.costly_range[1]), 1.0, 100.0))
    x = graph.op("Concat", free, costly, "query", graph.scaled("returns_to_go", 1, 0.1), axis=1)
    x = graph.op("Tanh", graph.linear(x, table.n_free + table.n_costly + table.n_queries + 1, width))
    tokens = []
    for layer in range(layers):
        x, key, value = _attention(graph, x, layer, manifest)
        tokens.append((key, value))
    graph.op("Identity", x, out="hidden")
    for index, out in enumerate(("new_keys", "new_values")):
        parts = [graph.op("Unsqueeze", token[index], graph.ints(0)) for token in tokens]
        graph.op("Concat", *parts, axis=0, out=out)
    low = np.array([c.low for c in spec.components], dtype=np.float32)
    span = np.array([c.high - c.low for c in spec.components], dtype=np.float32)
    score = graph.op("Sigmoid", graph.op("Add", graph.linear(x, width, spec.size), "noise"))
    graph.op("Add", graph.op("Mul", score, graph.constant(span)), graph.constant(low), out="action")
    cache, token = (layers, "N", heads, slots, dim), (layers, "N", heads, dim)
    inputs = {
        "free": ("N", table.n_free),
        "costly": ("N", table.n_costly),
        "query": ("N", table.n_queries),
        "returns_to_go": ("N", 1),
        "noise": ("N", spec.size),
        "keys": cache,
        "values": cache,
        "ages": ("N", slots),
    }
    outputs = {"action": ("N", spec.size), "hidden": ("N", width), "new_keys": token, "new_values": token}
    return graph.model(inputs, outputs)


def _attention(graph: _Graph, x: str, layer: int, manifest: Manifest) -> tuple[str, str, str]:
    """One causal attention step over the cached turns and this one, with a bias by age."""
    width, heads, dim = manifest.width, manifest.n_heads, manifest.head_dim
    split = graph.ints(-1, heads, dim)
    query, key, value = (graph.op("Reshape", graph.linear(x, width, width), split) for _ in range(3))
    keys, values = (graph.op("Gather", n, graph.constant(np.array(layer)), axis=0) for n in ("keys", "values"))
    ages = graph.op("Unsqueeze", "ages", graph.ints(1))  # [N, 1, S]
    bias = graph.scaled(graph.op("Cast", ages, to=TensorProto.FLOAT), 1, -0.2)
    cached = graph.op("Add", graph.op("Einsum", query, keys, equation="nhd,nhsd->nhs"), bias)
    empty = graph.op("GreaterOrEqual", ages, graph.ints(manifest.context_length))
    cached = graph.op("Where", empty, graph.constant(np.array(_MASKED, dtype=np.float32)), cached)
    own = graph.op("Unsqueeze", graph.op("Einsum", query, key, equation="nhd,nhd->nh"), graph.ints(2))
    weight = graph.op("Softmax", graph.op("Concat", cached, own, axis=2), axis=2)
    everything = graph.op("Concat", values, graph.op("Unsqueeze", value, graph.ints(2)), axis=2)
    mixed = graph.op("Einsum", weight, everything, equation="nhs,nhsd->nhd")
    mixed = graph.op("Reshape", mixed, graph.ints(-1, width))
    return graph.op("Add", x, graph.op("Tanh", graph.linear(mixed, width, width))), key, value


def _golden(path: Path, manifest: Manifest, seed: int) -> dict[str, np.ndarray]:
    """Record an episode with plain sessions and a cache kept as a list: no ring, no arena, no Policy."""
    table, layers, heads = manifest.features, manifest.n_layers, manifest.n_heads
    random, turns, noise_seed = np.random.default_rng(seed), 3 * manifest.context_length + 2, np.uint64(seed + 12345)
    head, trunk = (ort.InferenceSession(path / f"{graph}.onnx") for graph in ("acquisition", "action"))

    def draw(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return random.uniform(np.maximum(low, -2.0), np.minimum(high, 2.0), (turns, low.size)).astype(np.float32)

    free, costly = draw(*table.free_range), draw(*table.costly_range)
    rewards = np.concatenate([[0.0], random.normal(0.5, 0.3, turns - 1)]).astype(np.float32)
    hidden, past, rows = np.zeros((1, manifest.width), dtype=np.float32), [], []
    for turn in range(turns):
        left = np.array([[manifest.target_return - rewards[: turn + 1].sum(dtype=np.float64)]], dtype=np.float32)
        feed = {"hidden": hidden, "free": free[turn : turn + 1], "returns_to_go": left}
        probs = head.run(["query_probs"], feed)[0]
        noise = uniforms(np.array([noise_seed]), np.array([turn]), table.n_queries + manifest.action.size)
        query = noise[:, : table.n_queries] < probs
        kept = past[-manifest.n_slots :]
        cache = np.zeros((2, layers, 1, heads, manifest.n_slots, manifest.head_dim), dtype=np.float32)
        ages = np.full((1, manifest.n_slots), manifest.context_length, dtype=np.int64)
        for slot, token in enumerate(kept):
            cache[:, :, :, :, slot] = token
            ages[0, slot] = len(kept) - slot
        step = trunk.run(
            ["action", "hidden", "new_keys", "new_values"],
            {
                "free": free[turn : turn + 1],
                "costly": costly[turn : turn + 1] * query[:, table.owner],
                "query": query.astype(np.float32),
                "returns_to_go": left,
                "noise": noise[:, table.n_queries :],
                "keys": cache[0],
                "values": cache[1],
                "ages": ages,
            },
        )
        hidden = step[1]
        past.append(np.stack(step[2:]))
        rows.append((probs[0], query[0].astype(np.uint8), step[0][0], hidden[0]))
    probs, queries, actions, hiddens = (np.stack(column) for column in zip(*rows, strict=True))
    recorded = {"free": free, "costly": costly, "rewards": rewards, "probs": probs, "queries": queries}
    scalars = {"seed": noise_seed, "target_return": np.float64(manifest.target_return)}
    return {**recorded, "actions": actions, "hidden": hiddens, **scalars}
