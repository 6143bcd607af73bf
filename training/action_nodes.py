"""The action head as nodes of a graph: from the state that it reads to the action's numbers.

This module knows nothing about networks' other parts. Shape letters: W width of the state, A action components, B most
bins of any component.
"""

from __future__ import annotations

import numpy as np

from training.action_heads import ActionHead, BinsHead
from training.onnx_graph import OnnxGraph

__all__ = ["action_nodes"]

_NEVER = -1e9  # logit of a bin that a component does not have


def action_nodes(graph: OnnxGraph, head: ActionHead, hidden: str) -> None:
    """`action` [N, A] of the state `hidden` [N, W], reading `noise` [N, A] where a component is sampled."""
    weight, bias = (parameter.detach().double().numpy() for parameter in (head.weight.T, head.bias))
    low, high = head.low.double().numpy(), head.high.double().numpy()
    if isinstance(head, BinsHead):
        _bins(graph, head, hidden, weight, bias)
        return
    mean = graph.gemm(hidden, weight[:, : len(low)], bias[: len(low)])
    if (low == -1.0).all() and (high == 1.0).all():
        graph.op("Tanh", mean, out="action")
        return
    mean = graph.op("Tanh", mean)
    graph.gemm(mean, np.diag(0.5 * (high - low)), 0.5 * (low + high), out="action")


def _bins(graph: OnnxGraph, head: BinsHead, hidden: str, weight: np.ndarray, bias: np.ndarray) -> None:
    """All components side by side, as if each had B bins, and their values by one look-up."""
    components, most = len(head.bins), max(head.bins)
    wide, shift = np.zeros((len(weight), components, most)), np.full((components, most), _NEVER)
    values, ends = np.zeros((components, most)), np.cumsum(head.bins)
    for i, (bins, end) in enumerate(zip(head.bins, ends, strict=True)):
        wide[:, i, :bins], shift[i, :bins] = weight[:, end - bins : end], bias[end - bins : end]
        values[i, :bins] = np.linspace(float(head.low[i]), float(head.high[i]), bins)
    logits = graph.gemm(hidden, wide.reshape(len(weight), -1), shift.ravel())
    logits = graph.op("Reshape", logits, graph.ints([-1, components, most]))
    chosen = graph.op("ArgMax", logits, axis=2, keepdims=0)
    if any(head.sampled):
        sampled = graph.constant(np.array(head.sampled))
        chosen = graph.op("Where", sampled, _sampled(graph, head, logits), chosen)
    places = graph.op("Add", chosen, graph.ints(np.arange(components) * most))
    graph.op("Gather", graph.floats(values.ravel()), places, out="action")


def _sampled(graph: OnnxGraph, head: BinsHead, logits: str) -> str:
    """How many of the cumulative probabilities the noise has reached, [N, A] int64."""
    components, most = len(head.bins), max(head.bins)
    below = np.zeros((components, most, most - 1))  # probability of bin b counts into what is cumulated at c >= b
    for i, bins in enumerate(head.bins):
        below[i] = np.triu(np.ones((most, most)))[:, :-1]
        below[i, :, bins - 1 :] = 2.0  # the last bin ends above every noise, whatever rounding makes of its 1
    probs = graph.op("Unsqueeze", graph.op("Softmax", logits, axis=2), graph.ints([2]))  # [N, A, 1, B]
    cumulative = graph.op("MatMul", probs, graph.floats(below))  # [N, A, 1, B - 1]
    noise = graph.op("Unsqueeze", "noise", graph.ints([2, 3]))
    reached = graph.op("Cast", graph.op("GreaterOrEqual", noise, cumulative), to=graph.INT64)
    return graph.op("ReduceSum", reached, graph.ints([2, 3]), keepdims=0)
