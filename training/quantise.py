"""Large matrix products of a graph in int8, by scales that are fixed once (docs/adr/0012).

Weights are symmetric int8 with a scale for each output; numbers are uint8 with one scale for each product, found on
rows that were played. A scale that follows the batch (DynamicQuantizeLinear) would let one bot's numbers change
another's. Written as QuantizeLinear and DequantizeLinear around each product, of which onnxruntime makes integer
products.

This module knows nothing about bundles, files or episodes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

__all__ = ["Rows", "quantised"]

Rows = dict[str, NDArray[np.generic]]
"""A graph's inputs by name, of many turns: rows are batch rows."""

_LEAST_WEIGHTS = 12_000  # fewer are not worth the node that quantises their numbers
# What makes large differences of small ones: a product that such a node reads stays float32.
_SHARP = {"Sin", "Sigmoid", "Tanh", "Softmax", "ArgMax"}
_UNEVEN = 4.0  # columns whose range is so many times the median's: each gets a scale of its own first
_HEADROOM = 1.1  # of what was seen; what is beyond is clipped
# Normalisation divides by next to nothing what never changed in the traces: such a row, of a number that was always
# zero here too, would leave the others none of the 255 steps.
_NEVER_CHANGED = 1000.0  # times the median row
_STEPS, _MOST = 255, 127  # of uint8, and the largest int8 weight
_LARGEST_BIAS = 2.0**30  # in int32
_Floats = NDArray[np.float64]


def quantised(content: bytes, played: Rows, beside: dict[str, _Floats]) -> bytes:
    """The same graph with its large products in int8; what else there is stays as it is.

    `played` are all inputs of turns that were played; `beside` the least and largest number of each column of inputs
    that are known from elsewhere, [2, X]. Unchanged where no product is large.
    """
    model = onnx.load_from_string(content)
    rewriting = _Rewriting(model.graph)
    chosen = rewriting.large_products()
    if not chosen:
        return content
    limits = _limits(content, {node.input[0] for node in chosen}, played)
    for node in chosen:
        rewriting.drop_what_never_changed(node, limits[node.input[0]])
    for x in limits.keys() & beside.keys():
        limits[x] = np.stack([np.minimum(limits[x][0], beside[x][0]), np.maximum(limits[x][1], beside[x][1])])
    rewriting.rewrite(model.graph, {node.output[0] for node in chosen}, limits)
    onnx.checker.check_model(model, full_check=True)
    result: bytes = model.SerializeToString()
    return result


class _Rewriting:
    """The constants and nodes of one graph while they change."""

    def __init__(self, graph: onnx.GraphProto) -> None:
        self._constants = {each.name: numpy_helper.to_array(each) for each in graph.initializer}
        self._readers: dict[str, list[onnx.NodeProto]] = {}
        for node in graph.node:
            for name in node.input:
                self._readers.setdefault(name, []).append(node)
        self._maker = {name: node for node in graph.node for name in node.output}
        self._outputs = {port.name for port in graph.output}
        self._nodes: list[onnx.NodeProto] = []
        self._ready: dict[str, tuple[str, float]] = {}
        self._divisors: dict[str, _Floats] = {}

    def large_products(self) -> list[onnx.NodeProto]:
        """The Gemm nodes whose weights are many constants and whose results nothing sharp reads."""
        gemms = (node for node in self._maker.values() if node.op_type == "Gemm" and node.input[1] in self._constants)
        large = [node for node in gemms if self._constants[node.input[1]].size >= _LEAST_WEIGHTS]
        chosen = [node for node in large if _SHARP.isdisjoint(self._kinds_that_read(node.output[0]))]
        fewer = [node for node in chosen if self._relu_is_whole(node, chosen)]
        while len(fewer) < len(chosen):
            chosen, fewer = fewer, [node for node in fewer if self._relu_is_whole(node, fewer)]
        return chosen

    def drop_what_never_changed(self, node: onnx.NodeProto, seen_2X: _Floats) -> None:
        """Zero the weights of numbers that were always zero, where normalisation has blown them up."""
        weight = self._constants[node.input[1]]
        row_X = np.abs(weight).max(axis=1)
        blown_X = (row_X > _NEVER_CHANGED * np.median(row_X)) & ~seen_2X.any(axis=0)
        self._constants[node.input[1]] = np.where(blown_X[:, None], np.float32(0.0), weight)

    def rewrite(self, graph: onnx.GraphProto, chosen: set[str], limits: dict[str, _Floats]) -> None:
        """Replace the products with these results."""
        products = [self._maker[result] for result in chosen]
        for node in products:
            self._fold_constant_units(node)
        for x in dict.fromkeys(node.input[0] for node in products):
            self._even_out(x, [node for node in products if node.input[0] == x], limits)
        for node in graph.node:
            if node.output[0] in chosen:
                self._product(node, limits[node.input[0]])
            else:
                self._nodes.append(node)
        del graph.node[:], graph.initializer[:]
        graph.node.extend(self._nodes)
        read = {name for node in self._nodes for name in node.input}
        used = ((name, array) for name, array in self._constants.items() if name in read)
        graph.initializer.extend(numpy_helper.from_array(array, name) for name, array in used)

    def _kinds_that_read(self, name: str) -> Iterator[str]:
        for node in self._readers.get(name, ()):
            yield from self._kinds_that_read(node.output[0]) if node.op_type == "Reshape" else (node.op_type,)

    def _relu_is_whole(self, node: onnx.NodeProto, chosen: list[onnx.NodeProto]) -> bool:
        """Whether a Relu right behind this product has only chosen readers: else onnxruntime makes it one with the
        product in float32, and restores the weights in every run."""
        if node.input[2] not in self._constants:  # an Add comes between
            return True
        relus = [reader for reader in self._readers.get(node.output[0], ()) if reader.op_type == "Relu"]
        return all(reader in chosen for relu in relus for reader in self._readers[relu.output[0]])

    def _fold_constant_units(self, inner: onnx.NodeProto) -> None:
        """A hidden unit of no weights carries the next product's bias (`training.graphs`): make it a bias again, for
        the unit would take a column of its own."""
        relu = self._readers.get(inner.output[0], [])
        outer = self._readers.get(relu[0].output[0], []) if len(relu) == 1 and relu[0].op_type == "Relu" else []
        weight, bias = self._constants[inner.input[1]], self._constants.get(inner.input[2])
        if bias is None or len(outer) != 1 or outer[0].op_type != "Gemm" or outer[0].input[1] not in self._constants:
            return
        live = weight.any(axis=0)
        if live.all() or outer[0].input[2] in self._constants:
            return
        after = self._constants[outer[0].input[1]]
        self._constants[inner.input[1]], self._constants[inner.input[2]] = weight[:, live], bias[live]
        self._constants[outer[0].input[1]] = after[live]
        self._constants[f"{outer[0].output[0]}_bias"] = np.maximum(bias[~live], 0.0) @ after[~live]

    def _even_out(self, x: str, readers: list[onnx.NodeProto], limits: dict[str, _Floats]) -> None:
        """Columns of very different ranges get half of the difference as a scale each, their weights the other half
        (Xiao et al., SmoothQuant, ICML 2023, eq. 4 with alpha 0.5): in the constants of what makes x where nothing else
        reads it, else by a product before it is rounded."""
        weight_X = np.max([np.abs(self._constants[node.input[1]]).max(axis=1) for node in readers], axis=0)
        limits[x] = limits[x][:, : len(weight_X)]
        widest_X = np.abs(limits[x]).max(axis=0)
        if not widest_X.any() or widest_X.max() <= _UNEVEN * _usual(widest_X):
            return
        scale_X = np.sqrt(_never_zero(widest_X) / _never_zero(weight_X))
        limits[x] = limits[x] / scale_X
        for node in readers:
            self._constants[node.input[1]] = self._constants[node.input[1]] * scale_X[:, None].astype(np.float32)
        columns = self._columns(x) if len(self._readers[x]) == len(readers) else []
        for name in columns:
            self._constants[name] = self._constants[name] / scale_X.astype(np.float32)
        if not columns:
            self._divisors[x] = scale_X

    def _columns(self, x: str) -> list[str]:
        """The constants whose columns make each column of x as many times larger as they are: those of a normalisation,
        or of a product with a bias and a Relu behind it. Empty where there are none, or others see what they make."""
        maker = self._maker.get(x)
        if maker is None or x in self._outputs:
            return []
        if maker.op_type == "LayerNormalization":
            return list(maker.input[1:])
        inner = maker.input[0]
        if maker.op_type != "Relu" or inner in self._outputs or len(self._readers[inner]) > 1:
            return []
        product = self._maker.get(inner)
        named = list(product.input[1:]) if product is not None and product.op_type == "Gemm" else []
        return named if set(named) <= self._constants.keys() else []

    def _product(self, node: onnx.NodeProto, limits_2X: _Floats) -> None:
        x, weight, plus = node.input
        result = node.output[0]
        weight_XO = self._constants[weight].astype(np.float64)
        number, step = self._number(x, limits_2X)
        bias = self._constants.get(plus if plus in self._constants else f"{result}_bias")
        bias_O = np.zeros(weight_XO.shape[1]) if bias is None else bias.astype(np.float64)
        # So wide a step that the bias fits; it is the weights' where there are any.
        least_O = np.maximum(np.abs(bias_O) / (_LARGEST_BIAS * step), np.finfo(np.float32).tiny)
        scale_O = np.maximum(np.abs(weight_XO).max(axis=0) / _MOST, least_O).astype(np.float32).astype(np.float64)
        whole = self._constant(f"{weight}_q", np.rint(weight_XO / scale_O).astype(np.int8))
        inputs = [number, self._restored(whole, scale_O, axis=1)]
        if bias is not None:
            whole = self._constant(f"{result}_b", np.rint(bias_O / (step * scale_O)).astype(np.int32))
            inputs.append(self._restored(whole, step * scale_O, axis=0))
        if plus in self._constants:
            self._node("Gemm", *inputs, out=result)
        else:
            self._node("Add", self._node("Gemm", *inputs, out=f"{result}_p"), plus, out=result)

    def _number(self, x: str, limits_2X: _Floats) -> tuple[str, float]:
        """x as uint8 and back, and the step of it; made once for all readers. Zero stays zero exactly: what was not
        acquired must not be felt."""
        if x in self._ready:
            return self._ready[x]
        scaled = x
        if x in self._divisors:
            factor = self._constant(f"{x}_f", (1.0 / self._divisors[x]).astype(np.float32))
            scaled = self._node("Mul", x, factor, out=f"{x}_m")
        low, high = _HEADROOM * min(float(limits_2X.min()), 0.0), _HEADROOM * max(float(limits_2X.max()), 0.0)
        step = float(np.float32((high - low) / _STEPS)) or 1.0
        port = (self._constant(f"{x}_s", np.float32(step)), self._constant(f"{x}_z", np.uint8(round(-low / step))))
        whole = self._node("QuantizeLinear", scaled, *port, out=f"{x}_q")
        self._ready[x] = self._node("DequantizeLinear", whole, *port, out=f"{x}_d"), step
        return self._ready[x]

    def _restored(self, whole: str, scale_O: _Floats, axis: int) -> str:
        zero = np.zeros(len(scale_O), dtype=self._constants[whole].dtype)
        port = (self._constant(f"{whole}_s", scale_O.astype(np.float32)), self._constant(f"{whole}_z", zero))
        return self._node("DequantizeLinear", whole, *port, out=f"{whole}_d", axis=axis)

    def _constant(self, name: str, array: NDArray[np.generic] | np.generic) -> str:
        self._constants[name] = np.asarray(array)
        return name

    def _node(self, kind: str, *inputs: str, out: str, **attributes: int) -> str:
        self._nodes.append(helper.make_node(kind, list(inputs), [out], **attributes))
        return out


def _usual(sizes: _Floats) -> float:
    return float(np.median(sizes[sizes > 0.0])) if sizes.any() else 1.0


def _never_zero(sizes: _Floats) -> _Floats:
    return np.where(sizes > 0.0, sizes, _usual(sizes))


def _limits(content: bytes, names: set[str], rows: Rows) -> dict[str, _Floats]:
    """Least and largest of each column of these values over the rows, [2, X]."""
    model = onnx.load_from_string(content)
    inside = sorted(names - set(rows))
    model.graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in inside)
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    values = dict(zip(inside, session.run(inside, rows), strict=True)) if inside else {}
    values |= {name: rows[name] for name in names & set(rows)}
    return {name: np.stack([each.min(axis=0), each.max(axis=0)]).astype(np.float64) for name, each in values.items()}
