"""Large products in int8: near the float32 ones, the same in any batch, and really whole numbers in onnxruntime."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bot_runtime.graph import check_graph
from training.onnx_graph import OnnxGraph
from training.quantise import quantised

WIDE, NARROW = 128, 96  # 12,288 weights: just enough
TURNS = 40


def session(content: bytes, optimised: Path | None = None) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.log_severity_level = 3  # it warns that an optimised graph fits this processor
    if optimised is not None:
        options.optimized_model_filepath = str(optimised)
    return ort.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def run(content: bytes, x: np.ndarray) -> np.ndarray:
    (y,) = session(content).run(["y"], {"x": x})
    return y


def numbers(seed: int, rows: int = TURNS, width: int = WIDE) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, width)).astype(np.float32)


def perceptron(seed: int, ending: str | None = None, uneven: float = 1.0) -> bytes:
    """x -> WIDE -> y, with the second bias on a hidden unit that is always 1, as `training.graphs` writes it. `uneven`:
    how many times the others one hidden unit is."""
    random, graph = np.random.default_rng(seed), OnnxGraph()
    graph.inputs, graph.outputs = {"x": ("N", WIDE), "plus": ("N", NARROW)}, {"y": ("N", NARROW)}
    inner = np.concatenate([random.normal(size=(WIDE, WIDE)) / 11.0, np.zeros((WIDE, 1))], axis=1)
    inner[:, 0] *= uneven
    hidden = graph.op("Relu", graph.gemm("x", inner, np.append(random.normal(size=WIDE), 1.0)))
    outer = random.normal(size=(WIDE + 1, NARROW)) / 11.0
    y = graph.gemm(hidden, outer, "plus", out=None if ending else "y")
    if ending:
        graph.op(ending, graph.op("Reshape", y, graph.ints([-1, NARROW])), out="y")
    return graph.content()


def product(weight: np.ndarray, bias: np.ndarray) -> bytes:
    graph = OnnxGraph()
    graph.inputs, graph.outputs = {"x": ("N", len(weight))}, {"y": ("N", len(bias))}
    graph.gemm("x", weight, bias, out="y")
    return graph.content()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 1.0, 300.0]), st.floats(0.0, 1.0))
def test_the_error_is_half_a_step_of_each_number_and_each_weight(seed: int, size: float, dead: float) -> None:
    random = np.random.default_rng(seed)
    weight = (random.normal(size=(WIDE, NARROW)) * random.uniform(0.1, 1.0, NARROW)).astype(np.float32)
    weight[:, random.random(NARROW) < dead] = 0.0
    bias, x = (size * random.normal(size=NARROW)).astype(np.float32), numbers(seed) * np.float32(size)
    content = product(weight, bias)
    difference = np.abs(run(quantised(content, {"x": x}, {}), x) - run(content, x))
    x_step = 1.1 * (x.max() - x.min()) / 255.0
    weight_step = np.abs(weight).max(axis=0) / 127.0
    # Zero's own place is rounded as well, but a number in its range is never off by more than one step for it.
    bound = x_step * np.abs(weight).sum(axis=0) + weight_step * (np.abs(x) + x_step).sum(axis=1)[:, None]
    assert (difference <= bound + 1e-5 * size).all()
    assert difference.max() > 0.0 or dead == 1.0 or not weight.any()


def test_columns_of_different_ranges_keep_their_digits() -> None:
    """One of them in metres, the others 0 or 1, as rays have them: one step for all would be a third of the one."""
    x = np.random.default_rng(0).integers(0, 2, (TURNS, WIDE)).astype(np.float32)
    x[:, 0] *= 75.0
    weight = numbers(1, WIDE, NARROW)
    weight[0] /= 75.0
    content = product(weight, np.zeros(NARROW))
    difference = np.abs(run(quantised(content, {"x": x}, {}), x) - run(content, x))
    assert difference.max() <= 0.02 * np.abs(run(content, x)).max()


def test_no_row_depends_on_the_others() -> None:
    """Bit by bit: a scale that follows the batch would fail here."""
    model, x = perceptron(2), numbers(2)
    plus = numbers(3, TURNS, NARROW)
    made = session(quantised(model, {"x": x, "plus": plus}, {}))
    far = np.concatenate([x[:1], 1000.0 * x[1:]]).astype(np.float32)
    (alone,) = made.run(["y"], {"x": x[:1], "plus": plus[:1]})
    (among,) = made.run(["y"], {"x": far, "plus": plus})
    assert (alone[0] == among[0]).all()


def test_zero_is_exactly_zero() -> None:
    """What was not acquired is not felt: only the bias is left."""
    bias = numbers(4, 1, NARROW)[0]
    made = quantised(product(numbers(5, WIDE, NARROW), bias), {"x": numbers(6)}, {})
    y = run(made, np.zeros((1, WIDE), dtype=np.float32))
    assert y[0] == pytest.approx(bias, abs=6e-4)  # half a step of the bias


def test_what_is_known_beside_the_rows_counts() -> None:
    """A number that was never so large in what was played is not clipped where it is known to be."""
    weight, rows = numbers(7, WIDE, NARROW), np.clip(numbers(8), -1.0, 1.0)
    x = np.full((1, WIDE), 2.0, dtype=np.float32)
    content = product(weight, np.zeros(NARROW))
    clipped, whole = (
        run(quantised(content, {"x": rows}, beside), x)
        for beside in ({}, {"x": np.stack([np.full(WIDE, -2.0), np.full(WIDE, 2.0)])})
    )
    right = run(content, x)
    assert np.abs(whole - right).max() < 0.1 * np.abs(right).max() < np.abs(clipped - right).max()


def test_a_number_that_never_changed_leaves_the_others_their_steps() -> None:
    weight, x = numbers(9, WIDE, NARROW), numbers(10)
    x[:, 3], weight[3] = 0.0, 1e5
    content = product(weight, np.zeros(NARROW))
    assert np.abs(run(quantised(content, {"x": x}, {}), x) - run(content, x)).max() < 1.5


@pytest.mark.parametrize("ending", ["Sin", "Sigmoid", "Tanh"])
def test_what_something_sharp_reads_and_what_leads_to_it_stays(ending: str) -> None:
    content = perceptron(11, ending)
    assert quantised(content, {"x": numbers(0), "plus": numbers(1, TURNS, NARROW)}, {}) == content


def test_small_products_stay() -> None:
    content = product(numbers(0, WIDE, 64), np.zeros(64))
    assert quantised(content, {"x": numbers(1)}, {}) == content


@pytest.mark.parametrize("uneven", [1.0, 40.0])
def test_onnxruntime_multiplies_whole_numbers_only(tmp_path: Path, uneven: float) -> None:
    """A pattern that it does not know restores the weights in every run, which is slower than float32 was: so did a
    product between the Relu of uneven units and their rounding."""
    feed = {"x": numbers(12), "plus": numbers(13, TURNS, NARROW)}
    content = perceptron(12, uneven=uneven)
    made = quantised(content, feed, {})
    check_graph("action.onnx", made)
    (y,) = session(made, tmp_path / "optimised.onnx").run(["y"], feed)
    kinds = [node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert kinds == ["QuantizeLinear", "QGemm", "QGemm", "Add"]
    (right,) = session(content).run(["y"], feed)
    assert np.abs(y - right).max() <= 0.05 * np.abs(right).max()
    # The unit that is always 1 has become a bias: no column is spent on it.
    weights = [tuple(each.dims) for each in onnx.load_from_string(made).graph.initializer if len(each.dims) == 2]
    assert weights == [(WIDE, WIDE), (WIDE, NARROW)]


@pytest.mark.parametrize("seen_elsewhere", [False, True])
def test_the_scales_of_uneven_columns_go_into_a_normalisation_that_nothing_else_reads(
    tmp_path: Path, seen_elsewhere: bool
) -> None:
    graph, size = OnnxGraph(), np.ones(WIDE)
    size[::8] = 60.0
    graph.inputs, graph.outputs = {"x": ("N", WIDE)}, {"y": ("N", NARROW)}
    even = graph.op("LayerNormalization", "x", graph.floats(size), graph.floats(size), axis=-1)
    graph.gemm(even, numbers(14, WIDE, NARROW) / size[:, None], np.zeros(NARROW), out="y")
    if seen_elsewhere:
        graph.outputs["z"] = ("N", WIDE)
        graph.op("Relu", even, out="z")
    content, feed = graph.content(), {"x": numbers(15)}
    made = quantised(content, feed, {})
    (y,) = session(made, tmp_path / "optimised.onnx").run(["y"], feed)
    kinds = [node.op_type for node in onnx.load(tmp_path / "optimised.onnx").graph.node]
    assert ("Mul" in kinds) == seen_elsewhere
    assert np.abs(y - session(content).run(["y"], feed)[0]).max() <= 0.02 * np.abs(y).max()
    if seen_elsewhere:
        (before,), (after,) = (session(each).run(["z"], feed) for each in (content, made))
        assert (before == after).all()
