"""Graphs that do what no bundle may do are refused, though their hashes are right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from bot_runtime.bundle import Bundle
from bot_runtime.policy import Policy
from protocol.errors import BadBundle
from tests.bundles import rehash


def change_graph(path: Path, file: str, change: Callable[[onnx.ModelProto], None]) -> None:
    model = onnx.load(path / file)
    change(model)
    (path / file).write_bytes(model.SerializeToString())
    rehash(path)


def rename_input(model: onnx.ModelProto) -> None:
    known = model.graph.input[0].name
    for node in model.graph.node:
        node.input[:] = ["observed" if name == known else name for name in node.input]
    model.graph.input[0].name = "observed"


def freeze_batch(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 1


def use_a_loop(model: onnx.ModelProto) -> None:
    body = helper.make_graph([], "body", [], [])
    model.graph.node.append(helper.make_node("Loop", ["", ""], ["looped"], body=body))


def use_a_subgraph_in_an_allowed_op(model: onnx.ModelProto) -> None:
    body = helper.make_graph([], "body", [], [])
    model.graph.node.append(helper.make_node("Identity", ["prepared"], ["same"], body=body))


def use_another_domain(model: onnx.ModelProto) -> None:
    model.graph.node[0].domain = "com.microsoft"


def use_random_numbers(model: onnx.ModelProto) -> None:
    model.graph.node.append(helper.make_node("RandomNormal", [], ["drawn"], shape=[1]))


def keep_weights_outside(model: onnx.ModelProto) -> None:
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/hostname")


def keep_a_constant_outside(model: onnx.ModelProto) -> None:
    tensor = TensorProto(name="t", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    tensor.external_data.add(key="location", value="weights.bin")
    model.graph.node.append(helper.make_node("Constant", [], ["outside"], value=tensor))


def use_a_function(model: onnx.ModelProto) -> None:
    model.functions.add(name="f", domain="local")


def divide_by_zero(model: onnx.ModelProto) -> None:
    zero = helper.make_node("Sub", [model.graph.node[-1].input[0]] * 2, ["zero"])
    model.graph.node.insert(len(model.graph.node) - 1, zero)
    model.graph.node[-1].input[0] = "infinite"
    model.graph.node.insert(len(model.graph.node) - 1, helper.make_node("Div", ["zero", "zero"], ["infinite"]))


def test_only_onnx_is_loaded_never_another_format_that_nobody_checked(bundle: Bundle, tmp_path: Path) -> None:
    """onnxruntime guesses the format from bytes 4 to 8, which a protobuf message may hold too."""
    options = onnxruntime.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "model.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    onnxruntime.InferenceSession(bundle.acquisition, options)
    with pytest.raises(BadBundle, match="does not load"):
        Policy(Bundle(bundle.manifest, (tmp_path / "model.ort").read_bytes(), bundle.action, "0" * 64))


def answer_the_first_bot_only(model: onnx.ModelProto) -> None:
    last = model.graph.node[-1]
    name, last.output[0] = last.output[0], "all"
    for bound, number in (("from", 0), ("to", 1), ("axis", 0)):
        model.graph.initializer.append(numpy_helper.from_array(np.array([number]), bound))
    model.graph.node.append(helper.make_node("Slice", ["all", "from", "to", "axis"], [name]))


@pytest.mark.parametrize("file", ["acquisition.onnx", "action.onnx"])
@pytest.mark.parametrize(
    ("change", "match"),
    [
        (rename_input, "has inputs"),
        (freeze_batch, "has shape"),
        (use_a_loop, "operator 'Loop'|a subgraph"),
        (use_a_subgraph_in_an_allowed_op, "a subgraph"),
        (use_another_domain, "domain 'com.microsoft'"),
        (use_random_numbers, "operator 'RandomNormal'"),
        (keep_weights_outside, "another file"),
        (keep_a_constant_outside, "another file"),
        (use_a_function, "local functions"),
        (divide_by_zero, "differ by nan"),
        (answer_the_first_bot_only, r"of 3 bots has shape \[1"),
        (lambda model: model.ClearField("graph"), "holds 0 graphs"),
        (lambda model: model.graph.ClearField("node"), "does not load"),
    ],
)
def test_illegal_graph(copy: Path, file: str, change: Callable[[onnx.ModelProto], None], match: str) -> None:
    change_graph(copy, file, change)
    with pytest.raises(BadBundle, match=match):
        Bundle.load(copy)
