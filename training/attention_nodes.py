"""Attention of one turn as nodes of a graph: over the ring of keys and values, and over the turn itself.

What does not depend on a bot is computed here, once: the scale of attention goes into the queries, and the bias by age
is a table over the places of the ring (docs/adr/0010, 0018). This module knows nothing about networks' other parts.
Shape letters: W width, H heads, G heads of keys and values, R = H/G heads that share one, h head width, L layers, S
cached turns, P = 2S places of a ring.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from training.models import Attention
from training.onnx_graph import OnnxGraph

__all__ = ["attention_nodes", "bias_nodes"]

_MASKED = -1e9
_Doubles = NDArray[np.float64]


def bias_nodes(graph: OnnxGraph, layers: Sequence[Attention]) -> list[str]:
    """What each layer adds to the scores of the turns that it sees, [N, 1, G, R, S], with heads that share S + 1: by
    one look-up of `place` [N]."""
    table = np.stack([_age_table(attention) for attention in layers], axis=1)  # [P, L, G, R, S]
    biases = graph.op("Gather", graph.floats(table), "place", axis=0)
    return graph.split(biases, [1] * len(layers), axis=1) if len(layers) > 1 else [biases]


def attention_nodes(graph: OnnxGraph, attention: Attention, layer: int, x: str, bias: str) -> str:
    """Attention of this turn, [N, W], to the state `x` [N, W]; makes key_l and value_l [N, 1, G, 1, h] of it."""
    groups, head, sharing = attention.n_kv_heads, attention.head_dim, _sharing(attention)
    apart = graph.op("Reshape", graph.gemm(x, *_projection(attention)), graph.ints([-1, 1, groups, sharing + 2, head]))
    names = [f"query_{layer}", f"key_{layer}", f"value_{layer}"]
    query, key, value = graph.split(apart, [sharing, 1, 1], axis=3, outs=names)
    keys, values = (f"keys_{layer}", key), (f"values_{layer}", value)
    if sharing == 1:
        mixed = _beside_the_ring(graph, query, keys, values, bias, slots=attention.context_length - 1)
    else:
        mixed = _in_the_ring(graph, query, keys, values, bias)
    return graph.op("Reshape", mixed, graph.ints([-1, attention.n_heads * head]))


def _in_the_ring(graph: OnnxGraph, query: str, keys: tuple[str, str], values: tuple[str, str], bias: str) -> str:
    """Keys and values that heads share are few: to copy them behind each other takes less than the nodes that would
    score the new token apart, and the scores of R heads are one product."""
    scores = _scores(graph, query, graph.op("Concat", *keys, axis=3))
    weights = graph.op("Softmax", graph.op("Add", scores, bias), axis=-1)
    return graph.op("MatMul", weights, graph.op("Concat", *values, axis=3))


def _beside_the_ring(
    graph: OnnxGraph, query: str, keys: tuple[str, str], values: tuple[str, str], bias: str, slots: int
) -> str:
    """The new token is scored beside the ring, so that nothing is concatenated but scores."""
    (ring, key), (past, value) = keys, values
    scores = graph.op("Add", _scores(graph, query, ring), bias)
    own = graph.op("ReduceSum", graph.op("Mul", query, key), graph.ints([-1]), keepdims=1)
    weights = graph.op("Softmax", graph.op("Concat", scores, own, axis=-1), axis=-1)
    before, now = graph.split(weights, [slots, 1], axis=4)
    return graph.op("Add", graph.op("MatMul", before, past), graph.op("Mul", now, value))


def _scores(graph: OnnxGraph, query: str, keys: str) -> str:
    """onnxruntime multiplies by the transpose of the keys as they lie."""
    return graph.op("MatMul", query, graph.op("Transpose", keys, perm=[0, 1, 2, 4, 3]))


def _projection(attention: Attention) -> tuple[_Doubles, _Doubles]:
    """Weight and bias whose columns are, of each of G groups, its R queries by 1/√h, its key and its value."""
    groups, queries = attention.n_kv_heads, attention.n_heads * attention.head_dim
    rows = np.vstack([_numpy(attention.qkv.weight).T, _numpy(attention.qkv.bias)])
    rows[:, :queries] /= math.sqrt(attention.head_dim)
    parts = np.split(rows, [queries, queries + groups * attention.head_dim], axis=1)
    grouped = np.concatenate([part.reshape(len(rows), groups, -1) for part in parts], axis=2).reshape(len(rows), -1)
    return grouped[:-1], grouped[-1]


def _sharing(attention: Attention) -> int:
    return attention.n_heads // attention.n_kv_heads


def _age_table(attention: Attention) -> _Doubles:
    """Score added to each slot at each place of the ring, less what age 0 gets, [P, G, R, S]; where heads share, a
    column of zeros for age 0 behind them.

    Before turn t the place is t while t < S: slot s holds turn s, or nothing yet. From then on it is S + t mod S: slot
    t mod S holds the oldest turn, S ago.
    """
    slots = attention.context_length - 1
    place, slot = np.arange(2 * slots)[:, None], np.arange(slots)
    filling = place < slots
    ages = np.where(filling, place - slot, (place - slot - 1) % slots + 1)
    empty = filling & (slot >= place)
    bias = _numpy(attention.age_bias)
    table_PHS = np.where(empty[:, None], _MASKED, (bias[:, ages] - bias[:, :1, None]).transpose(1, 0, 2))
    table_PHS = table_PHS if _sharing(attention) == 1 else np.pad(table_PHS, ((0, 0), (0, 0), (0, 1)))
    return table_PHS.reshape(2 * slots, attention.n_kv_heads, _sharing(attention), -1)


def _numpy(tensor: Tensor) -> _Doubles:
    return tensor.detach().cpu().double().numpy()
