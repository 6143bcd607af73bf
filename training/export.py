"""From a run's checkpoint to a bundle: `python -m training.export runs/hard bundles/hard`.

Writes acquisition.onnx, action.onnx, golden.npz and manifest.json, then loads the bundle with the runtime's own loader,
which replays the golden episode: a bundle that leaves here has passed the check that a server makes. The files that
made it (config.json, versions.json, metrics.jsonl) are copied beside it, with the training curves as a picture.

`--int8` goes from a bundle to another (`training.int8`): `python -m training.export bundles/hard out/hard-int8 --int8`.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from rich.console import Console

from bot_runtime.bundle import Bundle
from bot_runtime.manifest import SCHEMA_VERSION, Manifest
from bot_runtime.noise import uniforms
from training.acquisition import rollout, sample_queries
from training.bundle_folder import file_entries, new_folder, write_manifest
from training.checkpoint import Trained, load_trained
from training.command import command, terminable
from training.config import TrainConfig
from training.curves import plot_curves
from training.feature_map import FEATURE_MAP
from training.graphs import acquisition_graph, action_graph, reads_noise
from training.int8 import Int8, export_int8, report_lines
from training.policy import ModelConfig

__all__ = ["ExportConfig", "export", "golden_episode", "write_graphs"]

_COPIED = ("config.json", "versions.json", "metrics.jsonl")


@dataclass(frozen=True)
class ExportConfig:
    """What to export, and where to."""

    run: tyro.conf.Positional[Path]  # folder written by training.train; with --int8 one of a bundle
    out: tyro.conf.Positional[Path]  # folder of the bundle; replaced if it exists
    name: str = ""  # of the bundle (empty: the run's)
    target_cost: float | None = None  # C asked for where an engine says none; conditioned runs only (None: the run's)
    tolerance: float = 1e-4  # largest |Δ| between torch and ONNX that is accepted; int8 finds its own
    int8: bool = False  # large matrix products in int8
    episodes: int = 0  # with --int8: so many episodes of either bundle, for their returns
    environment: str = ""  # of these episodes (empty: the one that the bundle names)
    seed: int = 1_000_000  # of the first of them

    def __post_init__(self) -> None:
        if self.int8 and self.target_cost is not None:
            raise ValueError(f"target_cost is {self.target_cost}, expected none with int8 (its source says it)")


def write_graphs(trained: Trained, folder: Path) -> None:
    """acquisition.onnx and action.onnx, for any number of bots N."""
    for name, graph in (("acquisition", acquisition_graph), ("action", action_graph)):
        (folder / f"{name}.onnx").write_bytes(graph(trained.model).content())


@torch.no_grad()
def golden_episode(trained: Trained, seed: int = 0) -> dict[str, np.ndarray]:
    """What the network does over one recorded episode, computed by torch over the whole episode at once, not
    incrementally: replaying it proves torch = ONNX = incremental. Queries are sampled with the runtime's own noise."""
    model, facts = trained.model, trained.facts
    free, costly, rewards = (facts.golden[name] for name in ("free", "costly", "rewards"))
    turns, n_queries = len(free), model.config.n_queries
    noise = uniforms(np.full(turns, seed, np.uint64), np.arange(turns), n_queries + model.config.n_actions)
    noise_BTn = torch.from_numpy(noise)[None]
    togo = facts.target_return - rewards.cumsum(0)
    target_cost = torch.full((1, turns, 1), model.config.target_cost)
    known = model.know(free[None], togo[None, :, None], target_cost, costly[None])
    query, _ = sample_queries(model, known, noise_BTn[..., :n_queries])
    played = rollout(model, known, query)
    golden = {
        "seed": np.uint64(seed),
        "target_return": np.float32(facts.target_return),
        "free": free.numpy(),
        "costly": costly.numpy(),
        "rewards": rewards.numpy(),
        "probs": played.probs_BTM[0].numpy(),
        "queries": query[0].numpy().astype(np.uint8),
        "actions": model.action_head.actions(played.hidden_BTW, noise_BTn[..., n_queries:])[0].numpy(),
    }
    if model.config.has_memory:
        golden["hidden"] = played.hidden_BTW[0].numpy()
    if model.config.budget_conditioned:
        golden["target_cost"] = np.float32(model.config.target_cost)
    return golden


def export(config: ExportConfig) -> Bundle:
    """Write the bundle, verify it, put it in place; an existing bundle is replaced only by one that verified.

    Raises ValueError for a target cost that the run cannot be asked for.
    """
    trained = load_trained(config.run / "checkpoint.pt")
    if config.target_cost is not None:
        trained.model.config = _asking(trained.model.config, config.target_cost)
    with new_folder(config.out) as folder:
        write_graphs(trained, folder)
        np.savez_compressed(folder / "golden.npz", **golden_episode(trained))
        write_manifest(folder, _manifest(trained, folder, config))
        bundle = Bundle.load(folder)
        for name in _COPIED:
            shutil.copy(config.run / name, folder / name)
        if trained.facts.feature_map is not None:
            trained.facts.feature_map.write(folder / FEATURE_MAP)
        plot_curves(folder / "metrics.jsonl", folder / "curves.png", trained.config)
    return bundle


def _asking(sizes: ModelConfig, target_cost: float) -> ModelConfig:
    if sizes.cost_range is None:
        raise ValueError(f"target_cost is {target_cost}, expected none: the run is not conditioned on a budget")
    low, high = sizes.cost_range
    if not low <= target_cost <= high:
        raise ValueError(f"target_cost is {target_cost}, expected within what was trained, {low} to {high}")
    return replace(sizes, target_cost=target_cost)


def _manifest(trained: Trained, folder: Path, asked: ExportConfig) -> Manifest:
    config, facts, sizes = trained.config, trained.facts, trained.model.config
    return Manifest(
        schema_version=SCHEMA_VERSION,
        name=asked.name or config.name,
        method=config.method,
        features=facts.features,
        action=facts.action,
        target_return=facts.target_return,
        target_cost=sizes.target_cost if sizes.budget_conditioned else None,
        **_context_sizes(sizes),
        prepared_width=sizes.encoder_width,
        samples_action=reads_noise(trained.model),
        budget=config.frame_budget,
        tolerance=asked.tolerance,
        files=file_entries(folder),
        provenance={
            "dataset": config.dataset_name,
            "environment": config.environment,
            "seed": str(config.seed),
            "updates": str(trained.done),
            "acquisition": config.acquisition,
            "trained_budget": "conditioned" if config.budgets else str(config.budget),
            **_references(config),
        },
    )


def _references(config: TrainConfig) -> dict[str, str]:
    returns = config.reference_returns
    return {} if returns is None else {"reference_returns": f"{returns[0]} {returns[1]}"}


def _context_sizes(sizes: ModelConfig) -> dict[str, int]:
    if not sizes.has_memory:
        return {"context_length": 1, "n_layers": 0, "n_heads": 0, "head_dim": 0, "width": 0}
    names = ("context_length", "n_layers", "n_heads", "width")
    shared = {} if sizes.n_kv_heads is None else {"n_kv_heads": sizes.n_kv_heads}
    return {name: getattr(sizes, name) for name in names} | {"head_dim": sizes.token[1]} | shared


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    console = Console()
    with command("stopped: nothing was written"), terminable():
        config = tyro.cli(ExportConfig, args=arguments, description=__doc__)
        if config.int8:
            bundle, report = export_int8(
                Int8(config.run, config.out, config.name, config.episodes, config.environment, config.seed)
            )
            for line in report_lines(report):
                console.print(line)
        else:
            bundle = export(config)
    manifest = bundle.manifest
    console.print(f"bundle {manifest.name}: verified, {sum(file.bytes for file in manifest.files.values()):,} bytes")


if __name__ == "__main__":
    main()
