"""An ONNX graph, node by node: float32 weights, names that are numbers, nothing about where it was made.

This module knows nothing about networks or files.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import ArrayLike
from onnx import TensorProto, helper, numpy_helper

__all__ = ["OnnxGraph"]

_OPSET = 17  # LayerNormalization came with it
_IR_VERSION = 8
_Shape = tuple[int | str, ...]


class OnnxGraph:
    """Collects nodes and constants. A value is known by its name; `inputs` and `outputs` are float32 values' shapes,
    but for inputs that `whole` names, which are int64."""

    INT64 = TensorProto.INT64  # for Cast

    def __init__(self) -> None:
        self.inputs: dict[str, _Shape] = {}
        self.outputs: dict[str, _Shape] = {}
        self.whole: set[str] = set()
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []

    def floats(self, numbers: ArrayLike) -> str:
        """A float32 constant."""
        return self.constant(np.asarray(numbers, dtype=np.float32))

    def ints(self, numbers: ArrayLike) -> str:
        """An int64 constant."""
        return self.constant(np.asarray(numbers, dtype=np.int64))

    def constant(self, array: np.ndarray) -> str:
        """A constant of the array's own type."""
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def op(self, kind: str, *inputs: str, out: str | None = None, **attributes: object) -> str:
        """One node with one output."""
        return self.ops(kind, *inputs, outs=[out or f"n{len(self._nodes)}"], **attributes)[0]

    def ops(self, kind: str, *inputs: str, outs: Sequence[str], **attributes: object) -> list[str]:
        """One node with these outputs."""
        self._nodes.append(helper.make_node(kind, list(inputs), list(outs), **attributes))
        return list(outs)

    def split(self, x: str, sizes: Sequence[int], axis: int, outs: Sequence[str] | None = None) -> list[str]:
        """Parts of these sizes along `axis`."""
        outs = outs or [f"n{len(self._nodes)}_{i}" for i in range(len(sizes))]
        return self.ops("Split", x, self.ints(sizes), outs=outs, axis=axis)

    def gemm(self, x: str, weight: ArrayLike, plus: ArrayLike | str, out: str | None = None) -> str:
        """x [N, I] times `weight` [I, O], plus a bias [O] or another value [N, O]."""
        plus = plus if isinstance(plus, str) else self.floats(plus)
        return self.op("Gemm", x, self.floats(weight), plus, out=out)

    def content(self) -> bytes:
        """The checked model."""

        def ports(shapes: dict[str, _Shape]) -> list[onnx.ValueInfoProto]:
            kinds = dict.fromkeys(self.whole, TensorProto.INT64)
            return [helper.make_tensor_value_info(n, kinds.get(n, TensorProto.FLOAT), s) for n, s in shapes.items()]

        graph = helper.make_graph(self._nodes, "graph", ports(self.inputs), ports(self.outputs), self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR_VERSION)
        onnx.checker.check_model(model, full_check=True)
        content: bytes = model.SerializeToString()
        return content
