"""The two ONNX graphs of a bundle behind two calls.

This module knows nothing about files, bots, turns or budgets: arrays in, arrays out, one row a bot. L layers, H heads,
S cached turns, d numbers a head, W numbers of hidden state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from protocol.errors import BadBundle

if TYPE_CHECKING:  # a bundle is verified by running its policy, so the import cannot go both ways at run time
    from bot_runtime.bundle import Bundle
    from bot_runtime.manifest import Manifest

__all__ = ["Cache", "Policy", "Step"]

Floats = NDArray[np.float32]
_FATAL_ONLY = 4
_Port = tuple[str, tuple[int | None, ...]]  # ONNX element type and shape, None where the axis is the batch


class Cache(NamedTuple):
    """Keys and values of the last S turns, each [L, N, H, S, d]."""

    keys: Floats
    values: Floats


class Step(NamedTuple):
    """What one turn computed: action [N, A], hidden [N, W], and the turn's own keys and values, each [L, N, H, d].

    Without a context W, L, H and d are 0: there is nothing but the action.
    """

    action_NA: Floats
    hidden_NW: Floats
    new_keys: Floats
    new_values: Floats

    @property
    def finite_N(self) -> NDArray[np.bool_]:
        """Which bots' numbers are all finite, shape [N]: one NaN in a cache would spoil a bot for good."""
        tokens = np.isfinite(self.new_keys) & np.isfinite(self.new_values)  # [L, N, H, d]
        outputs = np.isfinite(self.action_NA).all(axis=1) & np.isfinite(self.hidden_NW).all(axis=1)
        return np.logical_and(outputs, tokens.all(axis=(0, 2, 3)))


class Policy:
    """Two onnxruntime sessions. Raises BadBundle when a graph does not load or its ports are not the manifest's.

    Sessions hold no state between calls. Each runs on `threads` threads that sleep, never spin, between calls: an
    engine's frame thread may share the core.
    """

    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        self._acquisition = _session("acquisition.onnx", bundle.acquisition, threads)
        self._action = _session("action.onnx", bundle.action, threads)
        self._has_context, self._is_conditioned = bundle.manifest.has_context, bundle.manifest.is_conditioned
        inputs, outputs = _acquisition_ports(bundle.manifest)
        _check_ports("acquisition.onnx", self._acquisition, inputs, outputs)
        inputs, outputs = _action_ports(bundle.manifest)
        _check_ports("action.onnx", self._action, inputs, outputs)

    def query_probs(self, hidden_NW: Floats, free_NF: Floats, returns_to_go_N: Floats, target_cost_N: Floats) -> Floats:
        """Bernoulli means of each bot's query, shape [N, M] (π̂ of the paper, reading the state after the last turn).

        `target_cost_N` are shares of each bot's full cost in [0, 1], of no effect unless the network is conditioned on
        them; `hidden_NW` has no columns where the network has no context.
        """
        feed = {"free": free_NF, "returns_to_go": returns_to_go_N[:, None]}
        if self._has_context:
            feed["hidden"] = hidden_NW
        if self._is_conditioned:
            feed["target_cost"] = target_cost_N[:, None]
        probs_NM: Floats = self._acquisition.run(["query_probs"], _float32(feed))[0]
        return probs_NM

    def act(
        self,
        free_NF: Floats,
        costly_ND: Floats,
        query_NM: NDArray[np.bool_],
        returns_to_go_N: Floats,
        noise_NA: Floats,
        cache: Cache,
        ages_NS: NDArray[np.int64],
    ) -> Step:
        """One incremental trunk step for every bot (π̃ of the paper).

        `costly_ND` is zero where not acquired, `query_NM` is what was acquired, `noise_NA` is uniform in [0, 1). A
        network without a context reads neither `cache` nor `ages_NS`.
        """
        feed = {
            "free": free_NF,
            "costly": costly_ND,
            "query": query_NM,
            "returns_to_go": returns_to_go_N[:, None],
            "noise": noise_NA,
        }
        if not self._has_context:
            (action_NA,) = self._action.run(["action"], _float32(feed))
            nothing = np.zeros((0, len(action_NA), 0, 0), dtype=np.float32)
            return Step(action_NA, np.zeros((len(action_NA), 0), dtype=np.float32), nothing, nothing)
        arrays = _float32(feed | cache._asdict())
        arrays["ages"] = np.ascontiguousarray(ages_NS, dtype=np.int64)
        return Step(*self._action.run(["action", "hidden", "new_keys", "new_values"], arrays))


def _float32(feed: Mapping[str, NDArray[np.generic]]) -> dict[str, NDArray[np.generic]]:
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in feed.items()}


def _session(file: str, graph: bytes, threads: int) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_ALL
    options.log_severity_level = _FATAL_ONLY
    options.add_session_config_entry("session.load_model_format", "ONNX")  # never what the bytes seem to be
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    try:
        return ort.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a dozen unrelated types for a graph that it cannot load
        raise BadBundle(f"{file} does not load in onnxruntime: {str(error)[:300]}") from error


def _acquisition_ports(manifest: Manifest) -> tuple[dict[str, _Port], dict[str, _Port]]:
    table = manifest.features
    inputs = {"free": _floats(table.n_free), "returns_to_go": _floats(1)}
    if manifest.has_context:
        inputs["hidden"] = _floats(manifest.width)
    if manifest.is_conditioned:
        inputs["target_cost"] = _floats(1)
    return inputs, {"query_probs": _floats(table.n_queries)}


def _action_ports(manifest: Manifest) -> tuple[dict[str, _Port], dict[str, _Port]]:
    table = manifest.features
    inputs: dict[str, _Port] = {
        "free": _floats(table.n_free),
        "costly": _floats(table.n_costly),
        "query": _floats(table.n_queries),
        "returns_to_go": _floats(1),
        "noise": _floats(manifest.action.size),
    }
    outputs: dict[str, _Port] = {"action": _floats(manifest.action.size)}
    if manifest.has_context:
        layers, heads, slots, dim = manifest.n_layers, manifest.n_heads, manifest.n_slots, manifest.head_dim
        cache: _Port = ("tensor(float)", (layers, None, heads, slots, dim))
        token: _Port = ("tensor(float)", (layers, None, heads, dim))
        inputs |= {"keys": cache, "values": cache, "ages": ("tensor(int64)", (None, slots))}
        outputs |= {"hidden": _floats(manifest.width), "new_keys": token, "new_values": token}
    return inputs, outputs


def _floats(columns: int) -> _Port:
    return "tensor(float)", (None, columns)


def _check_ports(file: str, session: ort.InferenceSession, inputs: dict[str, _Port], outputs: dict[str, _Port]) -> None:
    for kind, ports, expected in (
        ("input", session.get_inputs(), inputs),
        ("output", session.get_outputs(), outputs),
    ):
        names = [port.name for port in ports]
        if sorted(names) != sorted(expected):
            raise BadBundle(f"{file} has {kind}s {sorted(names)}, expected {sorted(expected)}")
        for port in ports:
            element, shape = expected[port.name]
            if port.type != element:
                raise BadBundle(f"{file} {kind} {port.name} has type {port.type}, expected {element}")
            if not _shape_fits(port.shape, shape, exact=kind == "input"):
                raise BadBundle(f"{file} {kind} {port.name} has shape {port.shape}, expected {list(shape)}, None = any")


def _shape_fits(declared: list[int | str | None], expected: tuple[int | None, ...], *, exact: bool) -> bool:
    """Whether the batch axis is open and each other axis is the manifest's.

    Exporters leave computed output axes unnamed; those are settled when the loader runs the graph.
    """
    if len(declared) != len(expected):
        return False
    for got, want in zip(declared, expected, strict=True):
        is_open = not isinstance(got, int)
        if want is None and not is_open:
            return False
        if want is not None and got != want and (exact or not is_open):
            return False
    return True
