"""From a float32 bundle to one whose large matrix products are int8, and what that costs.

It starts from a bundle, not from a checkpoint: whoever has only what is served can make one, nothing of torch is
needed, and both bundles are of one network for certain. The acquisition graph stays as it is (docs/adr/0012).
"""

from __future__ import annotations

import dataclasses
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from bot_runtime.bundle import Bundle
from bot_runtime.golden import Golden, read_golden
from bot_runtime.manifest import MAX_INT8_TOLERANCE, MAX_TOLERANCE
from training.bundle_folder import file_entries, new_folder, write_manifest
from training.evaluate import EvaluateConfig, Evaluation, evaluate, write_evaluation
from training.feature_map import FEATURE_MAP
from training.quantise import quantised
from training.replayed import Replayed, replayed

__all__ = ["Int8", "Int8Report", "Returns", "export_int8", "report_lines"]

REPORT = "int8.json"
_COPIED = ("config.json", "versions.json", FEATURE_MAP)
_SHAKEN = 1e-6  # of each free number: what another processor's rounding may do
_SHAKES = 4
_GOLDEN_SEEDS = 8


@dataclass(frozen=True)
class Int8:
    """What to make, and how thoroughly to compare it."""

    source: Path  # folder of a float32 bundle
    out: Path  # replaced if it exists
    name: str = ""  # of the bundle (empty: the source's and -int8)
    episodes: int = 0  # of either bundle; 0: none are played
    environment: str = ""  # empty: the one that the bundle names
    seed: int = 1_000_000


@dataclass(frozen=True)
class Returns:
    """Both bundles over the same episodes."""

    environment: str
    episodes: int
    seed: int
    fp32_mean: float
    int8_mean: float
    lost_pct: float  # of the float32 bundle's return
    difference_stderr: float  # of the mean difference, episode by episode
    fp32_cost_pct: float
    int8_cost_pct: float


@dataclass(frozen=True)
class Int8Report:
    """What int8 changes on the golden episode, both bundles given the queries that float32 sampled."""

    source: str
    source_sha256: str  # of its manifest
    command: str
    date: str
    turns: int
    action_max: float  # |Δ| of any component
    action_mean: float
    same_actions_pct: float  # turns whose action is the same in every component
    probs_max: float
    probs_mean: float
    flips_pct: float  # of all decisions to acquire a feature or not, by the same noise
    flips_of_asked_pct: float  # the same in % of what is asked for
    tolerance: float
    fp32_bytes: int  # of both graphs
    int8_bytes: int
    returns: Returns | None


def export_int8(asked: Int8) -> tuple[Bundle, Int8Report]:
    """Write the int8 bundle with its own golden episode, verify it, compare it, put it in place.

    Beside it: `int8.json`, and `evaluation.json` where episodes were played. Raises BadBundle for a source that does
    not verify; ValueError for one that is int8 already or has no large product, and where a rounding may turn any of
    some golden episodes.
    """
    source = Bundle.load(asked.source)
    if source.manifest.precision != "fp32":
        raise ValueError(f"{asked.source} is {source.manifest.precision}, expected a float32 bundle")
    golden = read_golden((asked.source / "golden.npz").read_bytes(), source.manifest)
    before = replayed(source, golden, golden["queries"].astype(np.bool_))
    made = dataclasses.replace(source, action=quantised(source.action, before.given, {"acquired": _beside(golden)}))
    if made.action == source.action:
        raise ValueError(f"{asked.source} has no matrix product that is large enough")
    own, tolerance = _own_golden(made, golden)
    with new_folder(asked.out) as folder:
        (folder / "acquisition.onnx").write_bytes(made.acquisition)
        (folder / "action.onnx").write_bytes(made.action)
        np.savez_compressed(folder / "golden.npz", **own)
        manifest = msgspec.structs.replace(
            source.manifest,
            name=asked.name or f"{source.name}-int8",
            precision="int8",
            tolerance=tolerance,
            files=file_entries(folder),
            provenance={**source.manifest.provenance, "quantised_from": f"{source.name} {source.sha256}"},
        )
        write_manifest(folder, manifest)
        bundle = Bundle.load(folder)
        for name in _COPIED:
            if (asked.source / name).exists():
                shutil.copy(asked.source / name, folder / name)
        after = replayed(bundle, golden, golden["queries"].astype(np.bool_))
        report = _report(asked, source, bundle, before, after, _returns(asked, folder))
        (folder / REPORT).write_bytes(msgspec.json.format(msgspec.json.encode(report), indent=1) + b"\n")
    return bundle, report


def report_lines(report: Int8Report) -> Iterator[str]:
    """For people."""
    yield f"{report.turns} golden turns: {report.same_actions_pct:.1f} % have the same action"
    yield f"|Δ action| at most {report.action_max:.3g}, mean {report.action_mean:.2g}"
    yield f"query flips {report.flips_pct:.2f} % of all decisions, {report.flips_of_asked_pct:.1f} % of what is asked"
    yield f"graphs {report.fp32_bytes:,} -> {report.int8_bytes:,} bytes, golden tolerance {report.tolerance:.2g}"
    if report.returns is not None:
        each = report.returns
        means = f"{each.fp32_mean:.2f} -> {each.int8_mean:.2f}, {each.lost_pct:.2f} % less"
        yield f"return over {each.episodes} episodes {means} (± {each.difference_stderr:.2f})"
        yield f"asked for {each.fp32_cost_pct:.2f} -> {each.int8_cost_pct:.2f} % of the full cost"


def _beside(golden: Golden) -> np.ndarray:
    """Least and largest of each number of `acquired`, [2, D + M]: of all that was there to acquire, and a query's."""
    costly_TD, queries_TM = golden["costly"], golden["queries"]
    least, most = np.zeros(queries_TM.shape[1]), np.ones(queries_TM.shape[1])
    return np.stack([np.append(costly_TD.min(axis=0), least), np.append(costly_TD.max(axis=0), most)])


def _own_golden(bundle: Bundle, golden: Golden) -> tuple[Golden, float]:
    """The episode as this bundle plays it, and twice the largest |Δ| that shaking its free numbers makes.

    One rounding may move a number by a whole step of int8, and an action from one bin to another; an episode where
    that happens is played again with other noise.
    """
    for seed in range(_GOLDEN_SEEDS):
        own = {**golden, "seed": np.uint64(seed)}
        played = replayed(bundle, own)
        worst = max(_largest(played, shaken) for shaken in _shaken(bundle, own, played.queries_TM))
        if 2.0 * worst <= MAX_INT8_TOLERANCE:
            own |= {
                "probs": played.probs_TM,
                "queries": played.queries_TM.astype(np.uint8),
                "actions": played.actions_TA,
            }
            return own | ({"hidden": played.hidden_TW} if "hidden" in golden else {}), max(2.0 * worst, MAX_TOLERANCE)
    raise ValueError(f"in {_GOLDEN_SEEDS} golden episodes a rounding moves an output by {worst:g} or more")


def _shaken(bundle: Bundle, golden: Golden, queries_TM: np.ndarray) -> Iterator[Replayed]:
    free_TF = golden["free"].astype(np.float64)
    for shake in range(_SHAKES):
        factor_TF = 1.0 + _SHAKEN * np.random.default_rng(shake).normal(size=free_TF.shape)
        yield replayed(bundle, {**golden, "free": (free_TF * factor_TF).astype(np.float32)}, queries_TM)


def _largest(one: Replayed, other: Replayed) -> float:
    pairs = ((getattr(each, name) for each in (one, other)) for name in ("probs_TM", "actions_TA", "hidden_TW"))
    return max(float(np.abs(a - b).max(initial=0.0)) for a, b in pairs)


def _returns(asked: Int8, folder: Path) -> Returns | None:
    """Play both, and write the int8 bundle's evaluation beside it."""
    if not asked.episodes:
        return None
    results: list[tuple[Evaluation, np.ndarray]] = []
    for bundle in (asked.source, folder):
        config = EvaluateConfig(bundle, asked.environment, asked.episodes, asked.seed)
        evaluation, episodes = evaluate(config)
        results.append((evaluation, np.array([episode.total for episode in episodes])))
    write_evaluation(folder / "evaluation.json", evaluation, episodes)
    (fp32, fp32_returns), (int8, int8_returns) = results
    return Returns(
        environment=fp32.environment,
        episodes=asked.episodes,
        seed=asked.seed,
        fp32_mean=fp32.return_mean,
        int8_mean=int8.return_mean,
        lost_pct=100.0 * (fp32.return_mean - int8.return_mean) / abs(fp32.return_mean),
        difference_stderr=float((int8_returns - fp32_returns).std() / np.sqrt(asked.episodes)),
        fp32_cost_pct=fp32.soft_cost_pct,
        int8_cost_pct=int8.soft_cost_pct,
    )


def _report(
    asked: Int8, source: Bundle, made: Bundle, before: Replayed, after: Replayed, returns: Returns | None
) -> Int8Report:
    action_TA = np.abs(after.actions_TA - before.actions_TA)
    probs_TM = np.abs(after.probs_TM - before.probs_TM)
    asks_TM = before.noise_TM < before.probs_TM
    flips = int(np.count_nonzero(asks_TM != (after.noise_TM < after.probs_TM)))
    return Int8Report(
        source=source.name,
        source_sha256=source.sha256,
        command=f"python -m training.export {shlex.join(sys.argv[1:])}",
        date=datetime.now(UTC).date().isoformat(),
        turns=len(action_TA),
        action_max=float(action_TA.max()),
        action_mean=float(action_TA.mean()),
        same_actions_pct=100.0 * float((action_TA == 0.0).all(axis=1).mean()),
        probs_max=float(probs_TM.max()),
        probs_mean=float(probs_TM.mean()),
        flips_pct=100.0 * flips / asks_TM.size,
        flips_of_asked_pct=100.0 * flips / max(1, int(np.count_nonzero(asks_TM))),
        tolerance=made.manifest.tolerance,
        fp32_bytes=len(source.acquisition) + len(source.action),
        int8_bytes=len(made.acquisition) + len(made.action),
        returns=returns,
    )
