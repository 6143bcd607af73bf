"""What only torch reads: everything needed to go on training, and everything needed to export a bundle.

Tensors and plain values only, read with `weights_only=True`: a checkpoint cannot carry code.
"""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import msgspec
import torch

from protocol.features import ActionSpec, FeatureTable
from training.build import make_policy
from training.config import TrainConfig
from training.feature_map import FeatureMap
from training.policy import BudgetedPolicy, ModelConfig
from training.replace_file import replace_file
from training.steps import Layout
from training.trace_source import TraceSource
from training.update import TrainState

__all__ = ["Facts", "Trained", "load_checkpoint", "load_trained", "save_checkpoint"]


@dataclass(frozen=True)
class Facts:
    """What a bundle must say of the traces that it was trained on."""

    features: FeatureTable
    action: ActionSpec
    target_return: float
    golden: dict[str, torch.Tensor]  # free [T, F], costly [T, D], rewards [T] of one recorded episode
    feature_map: FeatureMap | None = None  # None: the environment itself tells free from costly

    @classmethod
    def of(cls, traces: TraceSource, target_return: float | None) -> Facts:
        """The facts of these traces; `target_return` None takes the 90th percentile of their returns."""
        layout, example = traces.layout, traces.example
        togo = example.returns_to_go_T
        golden = {
            "free": example.free_TF.clone(),
            "costly": example.costly_TD.float(),
            # A turn's reward is the one since the turn before it.
            "rewards": torch.cat([torch.zeros(1), togo[:-1] - togo[1:]]),
        }
        if target_return is None:
            target_return = traces.statistics.return_90
        return cls(layout.features, layout.action, target_return, golden, layout.feature_map)


@dataclass(frozen=True)
class Trained:
    """A finished (or interrupted) run, ready for export."""

    config: TrainConfig
    facts: Facts
    model: BudgetedPolicy
    done: int


def save_checkpoint(path: Path, config: TrainConfig, facts: Facts, state: TrainState) -> None:
    """Write atomically: a run that is killed keeps its last whole checkpoint."""
    data: dict[str, Any] = {
        "config": msgspec.json.encode(asdict(config), enc_hook=str).decode(),
        "model_config": msgspec.json.encode(state.model.config).decode(),
        "features": msgspec.json.encode(facts.features).decode(),
        "action": msgspec.json.encode(facts.action).decode(),
        "feature_map": msgspec.json.encode(facts.feature_map).decode(),
        "target_return": facts.target_return,
        "golden": facts.golden,
        "model": state.model.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "done": state.done,
        "penalty_weights": state.control.weights,
        "seconds": state.seconds,
        "lengthened": state.lengthened,
    }
    if state.critics is not None and state.critic_optimiser is not None:
        data |= {"critics": state.critics.state_dict(), "critic_optimiser": state.critic_optimiser.state_dict()}
    content = io.BytesIO()  # torch itself says nothing of a disk that is full
    torch.save(data, content)
    replace_file(path, content.getvalue())


def load_checkpoint(path: Path, config: TrainConfig, state: TrainState, layout: Layout) -> None:
    """Continue a run: its settings must be those it began with, but for how long it goes on and where. Raises
    ValueError."""
    data = _read(path)
    state.done, state.seconds = data["done"], data["seconds"]
    theirs, ours = _decode_config(data["config"]), config
    for name, value in asdict(ours).items():
        if name not in ("out", "device", "updates", "log_every", "checkpoint_every") and getattr(theirs, name) != value:
            raise ValueError(
                f"{path} was trained with {name} {getattr(theirs, name)}, this run has {value}: use another out"
            )
    state.lengthened = data.get("lengthened", {})
    if state.done and theirs.updates != config.updates:
        state.lengthened[state.done] = theirs.updates
    if state.done > config.updates:
        raise ValueError(f"{path} is of update {state.done}, expected at most updates {config.updates}")
    if _layout(data) != (layout.features, layout.action, layout.feature_map):
        raise ValueError(f"{path} was trained with other features, costs or actions than the traces have now")
    state.model.load_state_dict(data["model"])
    state.optimiser.load_state_dict(data["optimiser"])
    state.control.weights = list(data["penalty_weights"])
    if state.critics is not None and state.critic_optimiser is not None:
        state.critics.load_state_dict(data["critics"])
        state.critic_optimiser.load_state_dict(data["critic_optimiser"])


def load_trained(path: Path) -> Trained:
    """Read the network and facts of a run, for export. Raises FileNotFoundError."""
    if not path.exists():
        raise FileNotFoundError(
            f"{path} does not exist: training writes it every checkpoint_every updates, and at the end"
        )
    data = _read(path)
    model = make_policy(msgspec.json.decode(data["model_config"], type=ModelConfig))
    model.load_state_dict(data["model"])
    model.eval()
    features, action, feature_map = _layout(data)
    facts = Facts(features, action, data["target_return"], data["golden"], feature_map)
    return Trained(_decode_config(data["config"]), facts, model, data["done"])


def _read(path: Path) -> dict[str, Any]:
    """Raises ValueError for what is no checkpoint or not a whole one."""
    try:
        data = torch.load(path, weights_only=True, map_location="cpu")
    except (EOFError, KeyError, OSError, RuntimeError, UnpicklingError) as error:
        raise ValueError(f"{path} is no whole checkpoint") from error
    if not isinstance(data, dict) or "config" not in data:
        raise ValueError(f"{path} is no checkpoint of a run")
    return data


def _layout(data: dict[str, Any]) -> tuple[FeatureTable, ActionSpec, FeatureMap | None]:
    return (
        msgspec.json.decode(data["features"], type=FeatureTable),
        msgspec.json.decode(data["action"], type=ActionSpec),
        # Runs from before feature maps have none.
        msgspec.json.decode(data.get("feature_map", "null"), type=FeatureMap | None),
    )


def _decode_config(text: str) -> TrainConfig:
    return msgspec.convert(msgspec.json.decode(text), TrainConfig, dec_hook=lambda kind, value: kind(value))
