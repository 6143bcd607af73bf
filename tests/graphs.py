"""The two graphs of a tiny bundle, random weights and all: real ONNX, real causal attention where it has a context.

Every output depends on every input, but for what is prepared, which must not depend on the hidden state.
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
            kinds = {"place": TensorProto.INT64}
            return [helper.make_tensor_value_info(n, kinds.get(n, TensorProto.FLOAT), s) for n, s in shapes.items()]

        graph = helper.make_graph(self.nodes, "tiny", ports(inputs), ports(outputs), self.initializers)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
        onnx.checker.check_model(model, full_check=True)
        return model.SerializeToString()


def acquisition_graph(manifest: Manifest, seed: int) -> bytes:
    table, inner, width = manifest.features, manifest.width or _INNER, manifest.width
    graph = _Graph(seed)
    scale = np.concatenate([np.ones(width), 1.0 / np.maximum(np.abs(table.free_range[1]), 1.0), [0.1]])
    x, columns = graph.scaled("before", scale.size, scale), scale.size
    inputs = {"before": ("N", columns)}
    known = graph.scaled("before", scale.size, np.where(np.arange(scale.size) < width, 0.0, scale))
    graph.linear(known, columns, manifest.prepared_width, out="prepared")
    if manifest.is_conditioned:
        inputs["target_cost"] = ("N", 1)
        x, columns = graph.op("Concat", x, graph.scaled("target_cost", 1, 3.0), axis=1), columns + 1
    x = graph.op("Tanh", graph.linear(x, columns, inner))
    graph.op("Sigmoid", graph.linear(x, inner, table.n_queries), out="query_probs")
    return graph.model(inputs, {"query_probs": ("N", table.n_queries), "prepared": ("N", manifest.prepared_width)})


def action_graph(manifest: Manifest, seed: int) -> bytes:
    table, spec, inner, prepared = manifest.features, manifest.action, manifest.width or _INNER, manifest.prepared_width
    graph = _Graph(seed)
    scale = np.append(1.0 / np.clip(np.abs(table.costly_range[1]), 1.0, 100.0), np.ones(table.n_queries))
    x = graph.op("Concat", graph.scaled("acquired", scale.size, scale), "prepared", axis=1)
    x = graph.op("Tanh", graph.linear(x, scale.size + prepared, inner))
    inputs = {"prepared": ("N", prepared), "acquired": ("N", scale.size)}
    outputs = {"action": ("N", spec.size)}
    if manifest.has_context:
        x, inputs, outputs = _trunk(graph, x, manifest, inputs, outputs)
    low = np.array([c.low for c in spec.components], dtype=np.float32)
    span = np.array([c.high - c.low for c in spec.components], dtype=np.float32)
    score = graph.linear(x, inner, spec.size)
    if manifest.samples_action:
        inputs, score = {**inputs, "noise": ("N", spec.size)}, graph.op("Add", score, "noise")
    score = graph.op("Sigmoid", score)
    graph.op("Add", graph.op("Mul", score, graph.constant(span)), graph.constant(low), out="action")
    return graph.model(inputs, outputs)


def _trunk(
    graph: _Graph, x: str, manifest: Manifest, inputs: dict[str, tuple], outputs: dict[str, tuple]
) -> tuple[str, dict[str, tuple], dict[str, tuple]]:
    """The attention layers over `x`; their output, and all inputs and outputs with the context's."""
    slots, (heads, dim) = manifest.n_slots, manifest.token
    inputs, outputs = {**inputs, "place": ("N",)}, {**outputs, "hidden": ("N", manifest.width)}
    ages = graph.op("Gather", graph.constant(_ages(slots)), "place", axis=0)  # [N, S]
    for layer in range(manifest.n_layers):
        for name in ("key", "value"):
            inputs[f"{name}s_{layer}"] = ("N", 1, heads, slots, dim)
            outputs[f"{name}_{layer}"] = ("N", 1, heads, 1, dim)
        x = _attention(graph, x, layer, ages, manifest)
    graph.op("Identity", x, out="hidden")
    return x, inputs, outputs


def _ages(slots: int) -> np.ndarray:
    """How many turns ago each slot was written, or one more than there are slots where it is empty, by place: played
    through, a turn at a time."""
    ages, rows = np.full(slots, slots + 1), []
    for turn in range(2 * slots):
        rows.append(ages)
        ages = np.minimum(ages + 1, slots + 1)
        ages[turn % slots] = 1
    return np.stack(rows)


def _attention(graph: _Graph, x: str, layer: int, ages: str, manifest: Manifest) -> str:
    """One causal attention step over the cached turns and this one, with a bias by age."""
    width, slots, (groups, dim) = manifest.width, manifest.n_slots, manifest.token
    apart, token = graph.ints(-1, groups, manifest.n_heads // groups, dim), graph.ints(-1, 1, groups, 1, dim)
    ring = graph.ints(-1, groups, slots, dim)
    query, key, value = (graph.linear(x, width, columns) for columns in (width, groups * dim, groups * dim))
    query, keys, values = (
        graph.op("Reshape", query, apart),
        *(graph.op("Reshape", f"{name}s_{layer}", ring) for name in ("key", "value")),
    )
    for name, number in (("key", key), ("value", value)):
        graph.op("Reshape", number, token, out=f"{name}_{layer}")
    key, value = (graph.op("Reshape", number, graph.ints(-1, groups, dim)) for number in (key, value))
    ages = graph.op("Unsqueeze", ages, graph.ints(1, 2))  # [N, 1, 1, S]
    bias = graph.scaled(graph.op("Cast", ages, to=TensorProto.FLOAT), 1, -0.2)
    cached = graph.op("Add", graph.op("Einsum", query, keys, equation="ngrd,ngsd->ngrs"), bias)
    empty = graph.op("GreaterOrEqual", ages, graph.ints(manifest.context_length))
    cached = graph.op("Where", empty, graph.constant(np.array(_MASKED, dtype=np.float32)), cached)
    own = graph.op("Unsqueeze", graph.op("Einsum", query, key, equation="ngrd,ngd->ngr"), graph.ints(3))
    weight = graph.op("Softmax", graph.op("Concat", cached, own, axis=3), axis=3)
    everything = graph.op("Concat", values, graph.op("Unsqueeze", value, graph.ints(2)), axis=2)
    mixed = graph.op("Einsum", weight, everything, equation="ngrs,ngsd->ngrd")
    mixed = graph.op("Reshape", mixed, graph.ints(-1, width))
    return graph.op("Add", x, graph.op("Tanh", graph.linear(mixed, width, width)))
