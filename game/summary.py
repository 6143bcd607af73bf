"""What a demo's episodes add up to: the figures, as one table and as one line of JSON.

This module knows nothing about how the episodes were played. Two currencies of µs: *declared* costs are those of the
bundle's feature table (the paper's Godot measurements), which budgets are in; *measured* ones were timed in this run.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from game.squad import Leg
from protocol.client import Welcome
from protocol.features import CostModel

__all__ = ["Percentiles", "Summary", "full_features_return", "print_summary", "summarise"]


@dataclass(frozen=True)
class Percentiles:
    """µs."""

    p50: float
    p99: float


@dataclass(frozen=True)
class TurnLatency:
    """One turn (both round trips) of all live bots together; None where no turn went that way."""

    http: Percentiles | None
    socket: Percentiles | None


@dataclass(frozen=True)
class Summary:
    """The demo's figures; its fields are the JSON line. `per_frame` is per bot and frame, that is, per turn."""

    bundle: str
    map: str
    episodes: int
    return_mean: float
    return_full_features: float | None
    reached: int
    died: int
    timed_out: int
    turns: int
    cost_pct: float  # declared cost of what was asked for, of that of everything
    measured: bool  # whether budgets were kept by what casting was measured to take, instead of by declared costs
    budget_us: float
    largest_cost_us: float  # of the dearest query of all, by the costs that counted
    budget_violations: int
    charged_us_per_frame: float  # what queries cost by the costs that counted, in the mean
    fallbacks: int
    rays_us_cast_per_frame: float  # measured
    rays_us_full_per_frame: float  # measured, on every tenth turn
    rays_us_saved_per_frame: float
    declared_us_cast_per_frame: float
    declared_us_full_per_frame: float
    declared_us_saved_per_frame: float
    infer_us_per_frame: float  # the server's own time for a turn, shared over the bots of the message
    turn_us: TurnLatency
    picture: str | None

    def json_line(self) -> str:
        """One line of JSON, no NaN in it."""
        return json.dumps(asdict(self), allow_nan=False)


def full_features_return(bundle: Path | None) -> float | None:
    """Mean return of the model that sees every ray, as the bundle's folder states it, or None if it does not."""
    path = None if bundle is None else bundle / "full_features.json"
    if path is None or not path.is_file():
        return None
    return float(json.loads(path.read_text(encoding="utf-8"))["return_mean"])


def summarise(
    http: Leg,
    socket: Leg | None,
    welcome: Welcome,
    map_name: str,
    full_features: float | None,
    picture: Path | None,
    *,
    measured: bool = False,
) -> Summary:
    """Add up one or two legs. Violations are counted here, from what was asked for and the declared costs alone; where
    costs were `measured`, from what the server said that each query would cost."""
    legs = [http] if socket is None else [http, socket]
    episodes = [episode for leg in legs for episode in leg.episodes]
    declared = CostModel.declared(welcome.features)
    cost_us_T = np.concatenate([declared.query_cost_us(episode.queries) for episode in episodes])
    charged_us_T = np.concatenate([episode.charged_us for episode in episodes]) if measured else cost_us_T
    cast_us = _mean([episode.cast_us for episode in episodes])
    full_us = _mean([episode.full_cast_us for episode in episodes])
    cost_us = float(cost_us_T.mean())
    return Summary(
        bundle=welcome.bundle,
        map=map_name,
        episodes=len(episodes),
        return_mean=round(float(np.mean([episode.total for episode in episodes])), 3),
        return_full_features=full_features,
        reached=sum(episode.reached for episode in episodes),
        died=sum(episode.died for episode in episodes),
        timed_out=sum(not (episode.reached or episode.died) for episode in episodes),
        turns=len(cost_us_T),
        cost_pct=round(100.0 * cost_us / declared.full_us, 3),
        measured=measured,
        budget_us=welcome.budget_us,
        largest_cost_us=round(float(charged_us_T.max()), 3),
        budget_violations=int((charged_us_T > welcome.budget_us).sum()),
        charged_us_per_frame=round(float(charged_us_T.mean()), 2),
        fallbacks=sum(episode.fallbacks for episode in episodes),
        rays_us_cast_per_frame=round(cast_us, 2),
        rays_us_full_per_frame=round(full_us, 2),
        rays_us_saved_per_frame=round(full_us - cast_us, 2),
        declared_us_cast_per_frame=round(cost_us, 2),
        declared_us_full_per_frame=round(declared.full_us, 2),
        declared_us_saved_per_frame=round(declared.full_us - cost_us, 2),
        infer_us_per_frame=round(sum(leg.infer_us for leg in legs) / len(cost_us_T), 2),
        turn_us=TurnLatency(_percentiles(http.turn_us), None if socket is None else _percentiles(socket.turn_us)),
        picture=None if picture is None else str(picture),
    )


def print_summary(summary: Summary, console: Console) -> None:
    """The same figures for people."""
    table = Table(title=f"bundle {summary.bundle}, {summary.episodes} episodes on map {summary.map}", show_header=False)
    table.add_column(style="bold")
    table.add_column()
    table.add_row("mean return", _return(summary))
    endings = f"{summary.reached} reached the goal, {summary.died} died, {summary.timed_out} timed out"
    table.add_row("episodes", f"{endings}; {summary.turns} turns")
    table.add_row("full ray cost spent", f"{summary.cost_pct:.1f} %, by declared costs")
    table.add_row(
        "budget violations",
        f"{summary.budget_violations} of {summary.turns} turns; the dearest query cost "
        f"{summary.largest_cost_us:.2f} of {summary.budget_us:.2f} µs, "
        f"{'as measured with a margin' if summary.measured else 'by declared costs'}",
    )
    if summary.rays_us_full_per_frame > 0.0 and summary.declared_us_cast_per_frame > 0.0:
        cast = summary.rays_us_cast_per_frame / summary.declared_us_cast_per_frame
        full = summary.rays_us_full_per_frame / summary.declared_us_full_per_frame
        charged = f"; charged {summary.charged_us_per_frame:.1f} µs a turn" if summary.measured else ""
        table.add_row("measured / declared", f"{cast:.2f} for what was cast, {full:.2f} for all rays{charged}")
    if summary.fallbacks:
        table.add_row("fallbacks", f"{summary.fallbacks} turns whose action was not the learned one")
    for door, latency in (("HTTP", summary.turn_us.http), ("socket", summary.turn_us.socket)):
        told = "none" if latency is None else f"p50 {latency.p50:.0f} µs, p99 {latency.p99:.0f} µs, all live bots"
        table.add_row(f"turn over {door}", told)
    if summary.picture is not None:
        table.add_row("picture", summary.picture)
    console.print(table)
    console.print(_rays_table(summary))


def _rays_table(summary: Summary) -> Table:
    table = Table(title="µs of rays per bot and frame")
    for heading in ("costs", "cast", "all rays", "saved", "less network"):
        table.add_column(heading, justify="left" if heading == "costs" else "right")
    for name, cast_us, full_us in (
        ("measured here in pybullet", summary.rays_us_cast_per_frame, summary.rays_us_full_per_frame),
        ("declared by the bundle (Godot)", summary.declared_us_cast_per_frame, summary.declared_us_full_per_frame),
    ):
        net_us = full_us - cast_us - summary.infer_us_per_frame
        table.add_row(name, f"{cast_us:.1f}", f"{full_us:.1f}", f"{full_us - cast_us:.1f}", f"{net_us:.1f}")
    table.caption = (
        f"network: {summary.infer_us_per_frame:.1f} µs per bot and frame; all rays are timed every tenth turn"
    )
    return table


def _return(summary: Summary) -> str:
    if summary.return_full_features is None:
        return f"{summary.return_mean:.1f} (no full_features.json beside the bundle to compare with)"
    full = summary.return_full_features
    return f"{summary.return_mean:.1f}, {100 * summary.return_mean / full:.0f} % of the {full:.1f} with all rays"


def _mean(times_us: list[NDArray[np.float64]]) -> float:
    """Mean of the times that were taken, 0 if there was none."""
    taken = np.concatenate(times_us)
    taken = taken[~np.isnan(taken)]
    return float(taken.mean()) if taken.size else 0.0


def _percentiles(turn_us: NDArray[np.float64]) -> Percentiles | None:
    if turn_us.size == 0:
        return None
    return Percentiles(*(round(float(us), 1) for us in np.percentile(turn_us, (50, 99))))
