"""With and without a context, with and without a target cost: each kind loads, and none is taken for another."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from protocol.errors import BadBundle
from tests.bot_runtime.test_bundle import change_golden
from tests.bundles import make_bundle, rehash


@pytest.mark.parametrize("target_cost", [None, 0.0, 0.1, 1.0])
@pytest.mark.parametrize(("context_length", "method"), [(1, "rcbc"), (1, "bc"), (1, "iql"), (2, "bdt"), (4, "bdt")])
def test_loads(tmp_path: Path, context_length: int, method: str, target_cost: float | None) -> None:
    path = make_bundle(tmp_path, context_length=context_length, method=method, target_cost=target_cost)
    manifest = Bundle.load(path).manifest
    assert (manifest.method, manifest.target_cost) == (method, target_cost)
    assert (manifest.has_context, manifest.is_conditioned) == (context_length > 1, target_cost is not None)
    assert (manifest.n_slots, manifest.width) == (context_length - 1, 16 if context_length > 1 else 0)


def test_a_manifest_from_before_target_costs_still_loads(tmp_path: Path) -> None:
    path = make_bundle(tmp_path) / "manifest.json"
    manifest = msgspec.json.decode(path.read_bytes())
    del manifest["target_cost"]
    path.write_bytes(msgspec.json.encode(manifest))
    assert not Bundle.load(tmp_path).manifest.is_conditioned


@pytest.mark.parametrize("file", ["acquisition.onnx", "action.onnx"])
@pytest.mark.parametrize(
    ("made", "said"),
    [
        ({}, {"context_length": 1}),
        ({"context_length": 1}, {"context_length": 2, "n_layers": 1, "n_heads": 1, "head_dim": 1}),
        ({}, {"target_cost": 0.5}),
        ({"target_cost": 0.5}, {}),
        ({"samples_action": False}, {}),
        ({}, {"samples_action": False}),
    ],
)
def test_graphs_of_another_kind_than_the_manifest_says(
    tmp_path: Path, file: str, made: dict[str, Any], said: dict[str, Any]
) -> None:
    made_path, path = make_bundle(tmp_path / "made", **made), make_bundle(tmp_path / "said", **said)
    shutil.copy(made_path / file, path)
    rehash(path)
    read_by = {"target_cost": "acquisition.onnx", "samples_action": "action.onnx"}
    if any(read_by.get(field, file) != file for field in made | said):
        Bundle.load(path, replay=False)  # only the other graph reads it
        return
    with pytest.raises(BadBundle, match=f"{file} (has inputs|input before has shape) .*, expected"):
        Bundle.load(path)


@pytest.mark.parametrize("shape", [{"context_length": 1}, {"target_cost": 0.3}, {"samples_action": False}])
def test_golden_replay_of_every_kind_notices_a_difference(tmp_path: Path, shape: dict[str, Any]) -> None:
    path = make_bundle(tmp_path / "tiny", **shape)

    def nudge(arrays: dict[str, np.ndarray]) -> None:
        if "target_cost" in arrays:
            arrays["target_cost"] = arrays["target_cost"] + np.float32(0.2)
        else:
            arrays["probs"][-1, -1] += 3e-4

    change_golden(path, nudge)
    with pytest.raises(BadBundle, match="golden replay: probs"):
        Bundle.load(path)


@pytest.mark.parametrize(
    ("shape", "change"),
    [
        ({"context_length": 1}, lambda arrays: arrays.update(hidden=np.zeros((len(arrays["free"]), 0)))),
        ({"target_cost": 0.3}, lambda arrays: arrays.pop("target_cost")),
        ({}, lambda arrays: arrays.update(target_cost=np.float32(0.3))),
    ],
)
def test_golden_holds_what_its_kind_needs_and_no_more(
    tmp_path: Path, shape: dict[str, Any], change: Callable[[dict[str, np.ndarray]], None]
) -> None:
    path = make_bundle(tmp_path / "tiny", **shape)
    change_golden(path, change)
    with pytest.raises(BadBundle, match=r"golden\.npz holds"):
        Bundle.load(path)
