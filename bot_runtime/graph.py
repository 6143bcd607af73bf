"""What an ONNX file is made of, read from its bytes before onnxruntime sees them.

This module knows nothing about onnxruntime or manifests, and needs no `onnx` package: it walks the protobuf wire format
(https://protobuf.dev/programming-guides/encoding/) with the field numbers of onnx.proto. Field numbers below are
onnx.proto's, messages ModelProto, GraphProto, NodeProto, AttributeProto and TensorProto.
"""

from __future__ import annotations

from collections.abc import Iterator

from protocol.errors import BadBundle

__all__ = ["ALLOWED_OPS", "check_graph"]

# Dense arithmetic only: nothing loops, branches, draws numbers, reads strings or touches anything but its inputs. How
# long that takes (Expand and Tile make much of little) is for the loader to measure.
_OPS = """
    Abs Add And ArgMax ArgMin Cast CastLike Ceil Clip Concat Constant ConstantOfShape Cos Div DequantizeLinear
    DynamicQuantizeLinear Einsum Elu Equal Erf Exp Expand Flatten Floor Gather GatherElements GatherND Gelu Gemm Greater
    GreaterOrEqual HardSigmoid Identity IsInf IsNaN LayerNormalization LeakyRelu Less LessOrEqual Log LogSoftmax MatMul
    MatMulInteger Max Mean Min Mod Mul Neg Not Or Pow QuantizeLinear RMSNormalization Range Reciprocal ReduceL2
    ReduceLogSumExp ReduceMax ReduceMean ReduceMin ReduceProd ReduceSum ReduceSumSquare Relu Reshape Round Selu Shape
    Sigmoid Sign Sin Slice Softmax Softplus Softsign Split Sqrt Squeeze Sub Sum Tanh Tile TopK Transpose Trilu Unsqueeze
    Where Xor
"""
ALLOWED_OPS = frozenset(_OPS.split())
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MODEL_GRAPH, _MODEL_TRAINING, _MODEL_FUNCTIONS = 7, 20, 25
_GRAPH_NODE, _GRAPH_TENSOR, _GRAPH_SPARSE = 1, 5, 15
_NODE_OP, _NODE_ATTRIBUTE, _NODE_DOMAIN = 4, 5, 7
_ATTRIBUTE_TENSORS, _ATTRIBUTE_NESTED = (5, 10), {6: "a subgraph", 11: "a subgraph", 22: "sparse", 23: "sparse"}
_TENSOR_EXTERNAL = {13, 14}  # external_data, data_location


def check_graph(file: str, content: bytes) -> None:
    """Raises BadBundle unless `content` is a model of allowed operators whose numbers are all inside it.

    Refused: operators outside ALLOWED_OPS or of another domain, subgraphs, local functions, training graphs, sparse
    tensors, and tensors kept in other files.
    """
    try:
        graphs = 0
        for number, value in _fields(memoryview(content)):
            if number in (_MODEL_TRAINING, _MODEL_FUNCTIONS):
                raise BadBundle(f"{file} has local functions or a training graph, expected plain operators")
            if number == _MODEL_GRAPH:
                graphs += 1
                _check_nodes(file, value)
    except (IndexError, UnicodeDecodeError) as error:
        raise BadBundle(f"{file} is not a whole ONNX model") from error
    if graphs != 1:
        raise BadBundle(f"{file} holds {graphs} graphs, expected 1")


def _check_nodes(file: str, graph: memoryview) -> None:
    for number, value in _fields(graph):
        if number == _GRAPH_NODE:
            _check_node(file, value)
        elif number == _GRAPH_TENSOR:
            _check_tensor(file, value)
        elif number == _GRAPH_SPARSE:
            raise BadBundle(f"{file} has a sparse tensor, expected dense ones")


def _check_node(file: str, node: memoryview) -> None:
    for number, value in _fields(node):
        if number == _NODE_OP and str(value, "utf-8") not in ALLOWED_OPS:
            raise BadBundle(f"{file} uses operator {str(value, 'utf-8')[:80]!r}, which is not on the allow-list")
        if number == _NODE_DOMAIN and str(value, "utf-8") not in ("", "ai.onnx"):
            raise BadBundle(f"{file} uses operators of domain {str(value, 'utf-8')[:80]!r}, expected ai.onnx only")
        if number == _NODE_ATTRIBUTE:
            for attribute, nested in _fields(value):
                if attribute in _ATTRIBUTE_NESTED:
                    raise BadBundle(
                        f"{file} has {_ATTRIBUTE_NESTED[attribute]} in an attribute, expected dense tensors"
                    )
                if attribute in _ATTRIBUTE_TENSORS:
                    _check_tensor(file, nested)


def _check_tensor(file: str, tensor: memoryview) -> None:
    for number, value in _fields(tensor, varints=True):
        if number in _TENSOR_EXTERNAL and bytes(value) != b"\x00":
            raise BadBundle(f"{file} keeps a tensor in another file, expected all numbers inside")


def _fields(message: memoryview, *, varints: bool = False) -> Iterator[tuple[int, memoryview]]:
    """Number and content of each length-delimited field (and, when asked, of each varint).

    Every occurrence counts, where a protobuf reader might keep only the last: what is checked is a superset of what
    is read. Raises IndexError where the message ends early.
    """
    position, end = 0, len(message)
    while position < end:
        tag, position = _varint(message, position)
        number, wire = tag >> 3, tag & 7
        start = position
        if wire == _VARINT:
            _, position = _varint(message, position)
        elif wire == _BYTES:
            size, start = _varint(message, position)
            position = start + size
        elif wire in (_FIXED64, _FIXED32):
            position += 8 if wire == _FIXED64 else 4
        else:
            raise IndexError(f"wire type {wire}")
        if position > end:
            raise IndexError("the message ends inside a field")
        if wire == _BYTES or (varints and wire == _VARINT):
            yield number, message[start:position]


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise IndexError("a varint of more than ten bytes")
