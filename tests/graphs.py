"""The two graphs of a tiny bundle, random weights and all: real ONNX, real causal attention where it has a context.

Every output depends on every input.
"""

from __future__ import annotations

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from bot_runtime.manifest import Manifest

__all__ = ["acquisition_graph", "action_graph"]

_OPSET = 17
_IR_VERSION = 9
_MASKED = -1e9
_INNER = 16  # numbers between the layers of a network without a context


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


def acquisition_graph(manifest: Manifest, seed: int) -> bytes:
    table, inner = manifest.features, manifest.width or _INNER
    graph = _Graph(seed)
    free = graph.scaled("free", table.n_free, 1.0 / np.maximum(np.abs(table.free_range[1]), 1.0))
    inputs = {"free": ("N", table.n_free), "returns_to_go": ("N", 1)}
    read = [free, graph.scaled("returns_to_go", 1, 0.1)]
    if manifest.has_context:
        inputs, read = {"hidden": ("N", manifest.width), **inputs}, ["hidden", *read]
    if manifest.is_conditioned:
        inputs, read = {**inputs, "target_cost": ("N", 1)}, [*read, graph.scaled("target_cost", 1, 3.0)]
    x = graph.op("Concat", *read, axis=1)
    x = graph.op("Tanh", graph.linear(x, sum(columns for _, columns in inputs.values()), inner))
    graph.op("Sigmoid", graph.linear(x, inner, table.n_queries), out="query_probs")
    return graph.model(inputs, {"query_probs": ("N", table.n_queries)})


def action_graph(manifest: Manifest, seed: int) -> bytes:
    table, spec, inner = manifest.features, manifest.action, manifest.width or _INNER
    graph = _Graph(seed)
    free = graph.scaled("free", table.n_free, 1.0 / np.maximum(np.abs(table.free_range[1]), 1.0))
    costly = graph.scaled("costly", table.n_costly, 1.0 / np.clip(np.abs(table.costly_range[1]), 1.0, 100.0))
    x = graph.op("Concat", free, costly, "query", graph.scaled("returns_to_go", 1, 0.1), axis=1)
    x = graph.op("Tanh", graph.linear(x, table.n_free + table.n_costly + table.n_queries + 1, inner))
    inputs = {
        "free": ("N", table.n_free),
        "costly": ("N", table.n_costly),
        "query": ("N", table.n_queries),
        "returns_to_go": ("N", 1),
        "noise": ("N", spec.size),
    }
    outputs = {"action": ("N", spec.size)}
    if manifest.has_context:
        x, inputs, outputs = _trunk(graph, x, manifest, inputs, outputs)
    low = np.array([c.low for c in spec.components], dtype=np.float32)
    span = np.array([c.high - c.low for c in spec.components], dtype=np.float32)
    score = graph.op("Sigmoid", graph.op("Add", graph.linear(x, inner, spec.size), "noise"))
    graph.op("Add", graph.op("Mul", score, graph.constant(span)), graph.constant(low), out="action")
    return graph.model(inputs, outputs)


def _trunk(
    graph: _Graph, x: str, manifest: Manifest, inputs: dict[str, tuple], outputs: dict[str, tuple]
) -> tuple[str, dict[str, tuple], dict[str, tuple]]:
    """The attention layers over `x`; their output, and all inputs and outputs with the context's."""
    layers, heads, slots, dim = manifest.n_layers, manifest.n_heads, manifest.n_slots, manifest.head_dim
    tokens = []
    for layer in range(layers):
        x, key, value = _attention(graph, x, layer, manifest)
        tokens.append((key, value))
    graph.op("Identity", x, out="hidden")
    for index, out in enumerate(("new_keys", "new_values")):
        parts = [graph.op("Unsqueeze", token[index], graph.ints(0)) for token in tokens]
        graph.op("Concat", *parts, axis=0, out=out)
    cache, token = (layers, "N", heads, slots, dim), (layers, "N", heads, dim)
    inputs = {**inputs, "keys": cache, "values": cache, "ages": ("N", slots)}
    return x, inputs, {**outputs, "hidden": ("N", manifest.width), "new_keys": token, "new_values": token}


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
