"""The two ONNX graphs of a bundle behind two calls.

This module knows nothing about files, bots, turns or budgets. A batch's arrays are bound once to each graph, so that a
call copies nothing and makes nothing. L layers, S cached turns, W numbers of hidden state.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from bot_runtime.batch import Batch
from protocol.errors import BadBundle

if TYPE_CHECKING:  # a bundle is verified by running its policy, so the import cannot go both ways at run time
    from bot_runtime.bundle import Bundle
    from bot_runtime.manifest import Manifest

__all__ = ["Acquisition", "Policy", "action_arrays"]

_FATAL_ONLY = 4
_FLOAT = "tensor(float)"
_Port = tuple[str, tuple[int | None, ...]]  # ONNX element type and shape, None where the axis is the batch
_Ports = dict[str, _Port]
_Arrays = dict[str, NDArray[Any]]


class Acquisition:
    """The session of the acquisition graph: all that an engine with a head of its own runs. Raises as Policy does."""

    def __init__(self, manifest: Manifest, graph: bytes, threads: int = 1) -> None:
        self._manifest = manifest
        self.session = _session("acquisition.onnx", graph, threads)
        _check_ports("acquisition.onnx", self.session, *_acquisition_ports(manifest))

    def query_probs(self, batch: Batch) -> None:
        """Bernoulli means of each bot's query (π̂ of the paper, reading the state after the last turn), and what the
        action graph needs of what is known before it: from `before_NX` and `target_cost_N1` to `probs_NM`, `asked_NE`.

        Target costs are shares of each bot's full cost in [0, 1], of no effect unless the network is conditioned on
        them.
        """
        run = batch.runs.get("acquisition")
        if run is None:
            run = batch.runs["acquisition"] = _bound(self.session, *_acquisition_arrays(self._manifest, batch))
        run()


class Policy:
    """Two onnxruntime sessions. Raises BadBundle when a graph does not load or its ports are not the manifest's.

    Sessions hold no state between calls. Each runs on `threads` threads that sleep, never spin, between calls: an
    engine's frame thread may share the core.
    """

    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        self._manifest = bundle.manifest
        self._acquisition = Acquisition(bundle.manifest, bundle.acquisition, threads)
        self._action = _session("action.onnx", bundle.action, threads)
        _check_ports("action.onnx", self._action, *_action_ports(bundle.manifest))

    def query_probs(self, batch: Batch) -> None:
        """The first graph: see `Acquisition`."""
        self._acquisition.query_probs(batch)

    def act(self, batch: Batch) -> None:
        """One incremental trunk step for every bot (π̃ of the paper), to `action_NA`, `hidden_NW` and `tokens`.

        Reads `prepared_NE`, `acquired_NY` (costly numbers, zero where not acquired, and what was acquired), the context
        and, where a component of the action is sampled, `noise_NA`, uniform in [0, 1).
        """
        run = batch.runs.get("action")
        if run is None:
            run = batch.runs["action"] = _bound(self._action, *action_arrays(self._manifest, batch))
        run()

    def check_prepared(self) -> None:
        """Raises BadBundle where what is prepared depends on the hidden state. Every turn would then be felt for ever,
        and no number of last turns would rebuild a context.
        """
        inputs, _ = _acquisition_ports(self._manifest)
        prepared = []
        for hidden in (0.0, 1.0):
            feed = {name: np.zeros(_sized(shape, 1), np.float32) for name, (_, shape) in inputs.items()}
            feed["before"][:, : self._manifest.width] = hidden
            prepared += self._acquisition.session.run(["prepared"], feed)
        if prepared[0].tobytes() != prepared[1].tobytes():
            raise BadBundle("prepared depends on the hidden state in before, expected on the other numbers only")

    def check_batch(self, n_bots: int, clock: Callable[[], int] = time.perf_counter_ns) -> float:
        """Run both graphs on zeros; how many µs that took by a clock that counts ns.

        Raises BadBundle where an output is not of the manifest's shape for so many bots: a golden episode has one bot,
        and exporters like to freeze a batch of one.
        """
        took_ns = 0
        for session, (inputs, outputs) in (
            (self._acquisition.session, _acquisition_ports(self._manifest)),
            (self._action, _action_ports(self._manifest)),
        ):
            feed = {
                name: np.full(_sized(shape, n_bots), 0, np.float32 if element == _FLOAT else np.int64)  # in memory now
                for name, (element, shape) in inputs.items()
            }
            started_ns = clock()
            computed = session.run(list(outputs), feed)
            took_ns += clock() - started_ns
            for name, array in zip(outputs, computed, strict=True):
                expected = _sized(outputs[name][1], n_bots)
                if array.shape != expected:
                    found = f"{name} of {n_bots} bots has shape {list(array.shape)}"
                    raise BadBundle(f"{found}, expected {list(expected)}")
        return took_ns / 1e3


def _bound(session: ort.InferenceSession, inputs: _Arrays, outputs: _Arrays) -> Callable[[], Any]:
    """A call that runs the session on these arrays as they then are, which it keeps alive."""
    binding = session.io_binding()
    for name, array in inputs.items():
        binding.bind_input(name, "cpu", 0, array.dtype.type, array.shape, array.ctypes.data)
    for name, array in outputs.items():
        binding.bind_output(name, "cpu", 0, array.dtype.type, array.shape, array.ctypes.data)
    arrays = (inputs, outputs)

    def run(_: object = arrays) -> None:
        session.run_with_iobinding(binding)

    return run


def _acquisition_arrays(manifest: Manifest, batch: Batch) -> tuple[_Arrays, _Arrays]:
    inputs = {"before": batch.before_NX}
    if manifest.is_conditioned:
        inputs["target_cost"] = batch.target_cost_N1
    return inputs, {"query_probs": batch.probs_NM, "prepared": batch.asked_NE}


def action_arrays(manifest: Manifest, batch: Batch) -> tuple[_Arrays, _Arrays]:
    """The batch's arrays that the action graph reads, and those that it writes, by the names of its ports."""
    inputs: _Arrays = {"prepared": batch.prepared_NE, "acquired": batch.acquired_NY}
    outputs: _Arrays = {"action": batch.action_NA}
    if manifest.samples_action:
        inputs["noise"] = batch.noise_NA
    if manifest.has_context:
        inputs["place"], outputs["hidden"] = batch.place_N, batch.hidden_NW
    for layer in range(manifest.n_layers):
        for kind, name in enumerate(("key", "value")):
            inputs[f"{name}s_{layer}"] = batch.memory[layer, kind][:, None]
            outputs[f"{name}_{layer}"] = batch.tokens[layer, kind][:, None, :, None]
    return inputs, outputs


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


def _acquisition_ports(manifest: Manifest) -> tuple[_Ports, _Ports]:
    table = manifest.features
    inputs = {"before": _floats(manifest.width + table.n_free + 1)}
    if manifest.is_conditioned:
        inputs["target_cost"] = _floats(1)
    return inputs, {"query_probs": _floats(table.n_queries), "prepared": _floats(manifest.prepared_width)}


def _action_ports(manifest: Manifest) -> tuple[_Ports, _Ports]:
    table, slots, (heads, head) = manifest.features, manifest.n_slots, manifest.token
    inputs = {
        "prepared": _floats(manifest.prepared_width),
        "acquired": _floats(table.n_costly + table.n_queries),
    }
    outputs = {"action": _floats(manifest.action.size)}
    if manifest.samples_action:
        inputs["noise"] = _floats(manifest.action.size)
    if manifest.has_context:
        inputs["place"], outputs["hidden"] = ("tensor(int64)", (None,)), _floats(manifest.width)
    for layer in range(manifest.n_layers):
        for name in ("key", "value"):
            inputs[f"{name}s_{layer}"] = _floats(1, heads, slots, head)
            outputs[f"{name}_{layer}"] = _floats(1, heads, 1, head)
    return inputs, outputs


def _floats(*shape: int) -> _Port:
    return _FLOAT, (None, *shape)


def _sized(shape: tuple[int | None, ...], n_bots: int) -> tuple[int, ...]:
    return tuple(n_bots if size is None else size for size in shape)


def _check_ports(file: str, session: ort.InferenceSession, inputs: _Ports, outputs: _Ports) -> None:
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
