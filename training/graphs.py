"""The two graphs that a bundle serves, made by hand from the trained weights with as few nodes as there can be.

What does not depend on a bot is computed here, once: normalisation goes into the weights that follow it, a cosine is a
sine a quarter turn on (docs/adr/0010). Shape letters as in `training.models`; X numbers before the query.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from training.action_heads import BinsHead
from training.action_nodes import action_nodes
from training.attention_nodes import attention_nodes, bias_nodes
from training.mlp import BudgetedPerceptron
from training.models import BudgetedDecisionTransformer
from training.onnx_graph import OnnxGraph
from training.policy import COST_OCTAVES, BudgetedPolicy

__all__ = ["acquisition_graph", "action_graph", "reads_noise"]

# A mean so many scales from zero is taken off before the weights: float32 has seven digits, and a sum of two large
# numbers that cancel would keep few of them.
_FAR = 100.0
_Doubles = NDArray[np.float64]


def reads_noise(model: BudgetedPolicy) -> bool:
    """Whether the action graph has an input for noise: a component of the action is sampled."""
    head = model.action_head
    return isinstance(head, BinsHead) and any(head.sampled)


def acquisition_graph(model: BudgetedPolicy) -> OnnxGraph:
    """before [N, X] (the last hidden state, free, return-to-go) and, where C is an input, target_cost [N, 1]
    -> query_probs [N, M], prepared [N, E]: the encoder's share of what is known before the query."""
    config, graph = model.config, OnnxGraph()
    width = model.memory_width + config.n_free + 1
    graph.inputs["before"] = ("N", width)
    # What is prepared does not depend on the hidden state: its product would be of zeros for the most part.
    bounds = [graph.ints([each]) for each in (model.memory_width, width, 1)]
    x = graph.op("Slice", "before", *bounds) if model.memory_width else "before"
    mean, scale = _statistics(model)
    waves, frequencies = model.wave_number.numpy(), _numpy(model.wave_frequency)
    if config.cost_range is not None:
        low, high = config.cost_range
        graph.inputs["target_cost"] = ("N", 1)
        clipped = graph.op("Clip", "target_cost", graph.floats(low), graph.floats(high))
        x = graph.op("Concat", x, graph.op("Log", clipped), axis=1)
        mean, scale = np.append(mean, math.log(low)), np.append(scale, math.log(high / low))
        waves = np.append(waves, np.full(COST_OCTAVES, len(mean) - 1))
        frequencies = np.append(frequencies, math.pi * 2.0 ** np.arange(COST_OCTAVES))
    rows, n_waves = len(mean), len(waves)
    swing = np.zeros((rows, n_waves))
    swing[waves, np.arange(n_waves)] = frequencies
    if (np.abs(mean) * np.maximum(swing.max(axis=1, initial=0.0), 1.0) > _FAR * scale).any():
        x, mean = graph.op("Sub", x, graph.floats(mean)), np.zeros(rows)
    angles, phase = _normalised(np.concatenate([swing, swing], axis=1), mean, scale)
    phase[n_waves:] += math.pi / 2
    x = graph.op("Concat", x, graph.op("Sin", graph.gemm(x, angles, phase)), axis=1) if n_waves else x
    places = _context_rows(model, rows, n_waves)

    def read(layer: nn.Linear) -> tuple[_Doubles, _Doubles]:
        weight = np.zeros((rows + 2 * n_waves, config.encoder_width))
        weight[places[: layer.in_features]] = _numpy(layer.weight).T
        if not config.reads_returns:
            weight[config.n_free] = 0.0
        weight, bias = _normalised(weight, mean, scale)
        return weight, bias + _numpy(layer.bias)

    graph.gemm(x, *read(model.encode_context), out="prepared")
    _query_nodes(graph, model, x, *read(model.acquisition_head.from_context))
    graph.outputs = {"query_probs": ("N", config.n_queries), "prepared": ("N", config.encoder_width)}
    return graph


def _statistics(model: BudgetedPolicy) -> tuple[_Doubles, _Doubles]:
    """Mean and scale of the free numbers and the return-to-go, [F + 1]; the hidden state is taken as it is."""
    parts = (model.normalise_free, model.normalise_return)
    return np.concatenate([_numpy(part.mean) for part in parts]), np.concatenate([_numpy(part.scale) for part in parts])


def _context_rows(model: BudgetedPolicy, rows: int, n_waves: int) -> NDArray[np.int64]:
    """Which row of the graph's numbers (free, return-to-go, target cost, all sines, all cosines) each number is that
    `BudgetedPolicy.know` puts together."""
    config, free = model.config, len(model.wave_number)
    sines, cosines = rows + np.arange(n_waves), rows + n_waves + np.arange(n_waves)
    first = np.arange(config.n_free)
    cost = np.stack([sines[free:], cosines[free:]], axis=1).ravel()
    context = [first, sines[:free], cosines[:free], [config.n_free]]
    return np.concatenate([*context, [rows - 1] if config.budget_conditioned else [], cost]).astype(np.int64)


def _query_nodes(graph: OnnxGraph, model: BudgetedPolicy, x: str, weight: _Doubles, bias: _Doubles) -> None:
    """`query_probs` of the numbers `x`, which the acquisition head's hidden layer reads with these weights, and of the
    hidden state in `before`."""
    config, head, out = model.config, model.acquisition_head, model.acquisition_head.out
    if config.acquisition == "learned":
        x = graph.gemm(x, weight, bias)
        if head.from_memory is not None:
            recalled = np.zeros((graph.inputs["before"][1], config.encoder_width))
            recalled[: model.memory_width] = _numpy(head.from_memory.weight).T
            x = graph.gemm("before", recalled, x)
        hidden = graph.op("Relu", x)
        graph.op("Sigmoid", graph.gemm(hidden, _numpy(out.weight).T, _numpy(out.bias)), out="query_probs")
    elif config.acquisition == "random" and config.budget_conditioned:
        graph.gemm("target_cost", np.ones((1, config.n_queries)), np.zeros(config.n_queries), out="query_probs")
    else:
        prob = config.target_cost if config.acquisition == "random" else float(config.acquisition == "all")
        nothing = np.zeros((graph.inputs["before"][1], config.n_queries))
        graph.gemm("before", nothing, np.full(config.n_queries, prob), out="query_probs")


def action_graph(model: BudgetedPolicy) -> OnnxGraph:
    """prepared [N, E], acquired [N, D + M] (costly numbers, zero where not acquired; the query, 0 or 1), noise [N, A]
    where any is read -> action [N, A]. With memory also place [N] and, of each layer l, keys_l and values_l
    [N, 1, G, S, h] -> hidden [N, W], key_l and value_l [N, 1, G, 1, h]."""
    config, graph = model.config, OnnxGraph()
    graph.inputs["prepared"] = ("N", config.encoder_width)
    graph.inputs["acquired"] = ("N", len(config.owner) + config.n_queries)
    if reads_noise(model):
        graph.inputs["noise"] = ("N", config.n_actions)
    graph.outputs["action"] = ("N", config.n_actions)
    x = graph.op("Relu", _encoder_node(graph, model))
    if isinstance(model, BudgetedDecisionTransformer):
        x = _trunk_nodes(graph, model, _linear(graph, x, model.embed))
    elif isinstance(model, BudgetedPerceptron):
        for layer in model.layers:
            x = _linear(graph, x, layer) if isinstance(layer, nn.Linear) else graph.op("Relu", x)
    action_nodes(graph, model.action_head, x)
    return graph


def _encoder_node(graph: OnnxGraph, model: BudgetedPolicy) -> str:
    """prepared + W[(costly - mean) / scale ∘ q, q]: a number that was not acquired is zero, and so is its query, so the
    mean may come off through the query."""
    mean, scale = _numpy(model.normalise_costly.mean), _numpy(model.normalise_costly.scale)
    owner, numbers, plus = np.array(model.config.owner), len(mean), "prepared"
    weight = _numpy(model.encode_acquired.weight).T.copy()
    weight[:numbers] /= scale[:, None]
    far = np.flatnonzero(np.abs(mean) > _FAR * scale)
    if far.size:
        less_mean = np.zeros((len(weight), far.size))
        less_mean[far, np.arange(far.size)] = 1.0
        less_mean[numbers + owner[far], np.arange(far.size)] = -mean[far]
        plus = graph.gemm(graph.gemm("acquired", less_mean, np.zeros(far.size)), weight[far], plus)
        weight[far] = 0.0
    np.subtract.at(weight, numbers + owner, mean[:, None] * weight[:numbers])
    return graph.gemm("acquired", weight, plus)


def _trunk_nodes(graph: OnnxGraph, model: BudgetedDecisionTransformer, x: str) -> str:
    """One turn through every block; the state after it."""
    config, slots = model.config, model.config.context_length - 1
    heads, head = config.token
    graph.inputs["place"], graph.outputs["hidden"] = ("N",), ("N", config.width)
    graph.whole.add("place")
    biases_L = bias_nodes(graph, [block.attention for block in model.blocks])
    for layer, block in enumerate(model.blocks):
        for name in ("key", "value"):
            graph.inputs[f"{name}s_{layer}"] = ("N", 1, heads, slots, head)
            graph.outputs[f"{name}_{layer}"] = ("N", 1, heads, 1, head)
        mixed = attention_nodes(graph, block.attention, layer, _norm(graph, x, block.norm_attention), biases_L[layer])
        x = graph.op("Add", _linear(graph, mixed, block.attention.out), x)
        inner, outer = block.mlp[0], block.mlp[-1]
        # One more hidden unit, always 1, carries the second bias, for the residual takes its place.
        weight = np.concatenate([_numpy(inner.weight).T, np.zeros((config.width, 1))], axis=1)
        hidden = graph.op("Relu", graph.gemm(_norm(graph, x, block.norm_mlp), weight, np.append(_numpy(inner.bias), 1)))
        x = graph.gemm(hidden, np.concatenate([_numpy(outer.weight).T, _numpy(outer.bias)[None]]), x)
    return _norm(graph, x, model.norm_out, out="hidden")


def _linear(graph: OnnxGraph, x: str, layer: nn.Linear) -> str:
    return graph.gemm(x, _numpy(layer.weight).T, _numpy(layer.bias))


def _norm(graph: OnnxGraph, x: str, layer: nn.LayerNorm, out: str | None = None) -> str:
    weight, bias = graph.floats(_numpy(layer.weight)), graph.floats(_numpy(layer.bias))
    return graph.op("LayerNormalization", x, weight, bias, out=out, axis=-1, epsilon=layer.eps)


def _normalised(weight: _Doubles, mean: _Doubles, scale: _Doubles) -> tuple[_Doubles, _Doubles]:
    """Weight and bias that make of raw numbers what `weight` makes of normalised ones (its further rows stay)."""
    weight = weight.copy()
    weight[: len(scale)] /= scale[:, None]
    return weight, -mean @ weight[: len(scale)]


def _numpy(tensor: Tensor) -> _Doubles:
    return tensor.detach().cpu().double().numpy()
