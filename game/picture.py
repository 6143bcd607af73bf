"""The demo's picture: the map from above with every path, and what one episode asked for, frame by frame.

This module knows nothing about servers or how episodes are played. Colours are those of Okabe and Ito, which people who
are colour-blind tell apart; what kills is hatched as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from game.rays import RANGES_M, RAYS
from game.squad import Episode
from game.terrain import Rect, Terrain
from protocol.features import CostModel

__all__ = ["draw_picture", "shown_episode"]

_DEADLY = {
    "lava": {"facecolor": "#e8a27a", "edgecolor": "#D55E00", "hatch": "xxx"},
    "water": {"facecolor": "#b5def6", "edgecolor": "#0072B2", "hatch": "---"},
}
_GROUND, _WALL, _LEDGE, _PATH, _ASKED = "#f4f1ea", "#4a4a4a", "#d8c9a8", "#222222", "#0072B2"
_BRIDGE = {"facecolor": _GROUND, "edgecolor": "#7a5c2e"}
_DASHES = (0, (2, 2))
_DOT_AREA = 45.0
"""Points² of the dot of a turn that spends the whole budget."""


def draw_picture(
    path: Path, terrain: Terrain, episodes: Sequence[Episode], costs: CostModel, budget_us: float, title: str
) -> None:
    """Write the PNG; its folder is there. Raises OSError."""
    shown = shown_episode(episodes)
    cost_us_T = costs.query_cost_us(shown.queries)
    figure = Figure(figsize=(15, 7.2), layout="constrained")
    reached = sum(episode.reached for episode in episodes)
    figure.suptitle(f"{title}: {reached} of {len(episodes)} episodes reached their goal", fontsize=14)
    panels = figure.subplot_mosaic([["map", "rays"], ["map", "cost"]], width_ratios=(1.25, 1), height_ratios=(2.2, 1))
    map_axes, ray_axes, cost_axes = panels["map"], panels["rays"], panels["cost"]
    _draw_map(map_axes, terrain, shown)
    _draw_paths(map_axes, episodes, shown, cost_us_T / max(budget_us, 1e-9))
    _explain(figure, terrain)
    _draw_rays(ray_axes, shown)
    _draw_costs(cost_axes, cost_us_T, budget_us, costs.full_us)
    for axes in (ray_axes, cost_axes):
        _mark_crossings(axes, terrain, shown, labelled=axes is ray_axes)
        axes.set_xlim(0, shown.turns)
    ray_axes.tick_params(labelbottom=False)
    figure.savefig(path, dpi=110)


def shown_episode(episodes: Sequence[Episode]) -> Episode:
    """The one that is drawn in full: of median length among those that reached their goal, or else among all."""
    candidates = [episode for episode in episodes if episode.reached] or list(episodes)
    return sorted(candidates, key=lambda episode: episode.turns)[len(candidates) // 2]


def _draw_map(axes: Axes, terrain: Terrain, shown: Episode) -> None:
    """What stands and lies where, with the bridges and pools of the shown episode."""
    half_x, half_y = terrain.size_m[0] / 2, terrain.size_m[1] / 2
    _add(axes, (-half_x, -half_y, half_x, half_y), facecolor=_GROUND, edgecolor=_WALL, linewidth=4)
    for ledge in terrain.ledges:
        _add(axes, ledge.rect, facecolor=_LEDGE, edgecolor="#8a7a55", linewidth=0.8)
    for hazard in (*terrain.hazards, *terrain.rivers, *shown.layout.pools):
        _add(axes, hazard.rect, linewidth=0.6, **_DEADLY[hazard.kind])
    for river, standing in zip(terrain.rivers, shown.layout.bridges, strict=True):
        for slot, stands in zip(river.slots, standing, strict=True):
            if stands:
                _add(axes, slot, linewidth=2.0, **_BRIDGE)
            else:
                _add(axes, slot, facecolor="none", edgecolor="white", linewidth=1.8, linestyle=_DASHES)
    for wall in terrain.walls:
        _add(axes, wall.rect, facecolor=_WALL, edgecolor=_WALL)
    drawn = ", with its own bridges and pools" if terrain.rivers or terrain.pools else ""
    axes.set_title(f"From above: episode {shown.seed} ({shown.ending}){drawn}", fontsize=11)
    axes.set_xlim(-half_x - 1, half_x + 1)
    axes.set_ylim(-half_y - 1, half_y + 1)
    axes.set_aspect("equal")
    axes.set_xlabel("x, metres")
    axes.set_ylabel("y, metres")


def _draw_paths(axes: Axes, episodes: Sequence[Episode], shown: Episode, share_T: np.ndarray) -> None:
    for episode in episodes:
        if episode is shown:
            continue
        axes.plot(*episode.path_m.T, color="#777777", linewidth=0.9, alpha=0.7, zorder=3)
        if not episode.reached:
            axes.plot(*episode.path_m[-1], "x" if episode.died else "s", color="black", markersize=7, zorder=6)
    axes.plot(*shown.path_m.T, color=_PATH, linewidth=1.6, zorder=4)
    axes.scatter(
        *shown.path_m[:-1].T, s=_DOT_AREA * share_T, color="#CC79A7", edgecolors=_PATH, linewidths=0.5, zorder=5
    )
    axes.plot(*shown.layout.start, "o", color="white", markeredgecolor="black", markersize=10, zorder=7)
    axes.plot(*shown.layout.goal, "*", color="#F0E442", markeredgecolor="black", markersize=18, zorder=7)


def _explain(figure: Figure, terrain: Terrain) -> None:
    bridges = [
        Patch(label="standing bridge", **_BRIDGE),
        Patch(label="missing bridge", facecolor="#999999", edgecolor="white", linewidth=1.8, linestyle=_DASHES),
    ]
    marks = {"linestyle": "none", "markeredgecolor": "black"}
    handles = [
        Line2D([], [], marker="o", color="white", markersize=9, label="start", **marks),
        Line2D([], [], marker="*", color="#F0E442", markersize=14, label="goal", **marks),
        Line2D([], [], color=_PATH, marker="o", markerfacecolor="#CC79A7", label="path, dot area: µs of rays"),
        Line2D([], [], color="#777777", label="other episodes" + (", other bridges" if terrain.rivers else "")),
        Line2D([], [], marker="x", color="black", label="died", **marks),
        Line2D([], [], marker="s", color="black", label="timed out", **marks),
        *(Patch(label=kind, **style) for kind, style in _DEADLY.items()),
        *(bridges if terrain.rivers else []),
        Patch(label="ledge", facecolor=_LEDGE, edgecolor="#8a7a55"),
        Patch(label="wall", facecolor=_WALL),
    ]
    figure.legend(
        handles=handles, ncols=len(handles), loc="outside lower center", frameon=False, fontsize=9,
        handletextpad=0.5, columnspacing=1.2,
    )  # fmt: skip


def _draw_rays(axes: Axes, shown: Episode) -> None:
    """Rays x frames, rows grouped by range, leftmost ray of each group on top."""
    ranges_M = np.array([ray.range_m for ray in RAYS])
    order_M = np.lexsort(([-ray.left_deg for ray in RAYS], ranges_M))
    axes.imshow(
        shown.queries[:, order_M].T, aspect="auto", interpolation="none", cmap=ListedColormap(["none", _ASKED]),
        vmin=0, vmax=1, extent=(0, shown.turns, len(RAYS), 0),
    )  # fmt: skip
    edges = np.concatenate([[0], np.cumsum([np.count_nonzero(ranges_M == range_m) for range_m in RANGES_M])])
    for edge in edges[1:-1]:
        axes.axhline(edge, color="#999999", linewidth=0.8)
    asked_pct = [100.0 * shown.queries[:, ranges_M == range_m].mean() for range_m in RANGES_M]
    labels = [f"{range_m} m\n{pct:.0f} %" for range_m, pct in zip(RANGES_M, asked_pct, strict=True)]
    axes.set_yticks((edges[:-1] + edges[1:]) / 2, labels)
    axes.tick_params(axis="y", length=0)
    axes.set_ylabel("range of the ray, and how often it was asked for\n(in each range: left to right is top to bottom)")
    axes.set_title(f"Rays asked for along episode {shown.seed}: {100 * shown.queries.mean():.1f} % of all", fontsize=11)


def _draw_costs(axes: Axes, cost_us_T: np.ndarray, budget_us: float, full_us: float) -> None:
    axes.stairs(cost_us_T, np.arange(len(cost_us_T) + 1), fill=True, color="#CC79A7", label="spent")
    axes.axhline(budget_us, color="black", linestyle="--", linewidth=1.5, label=f"budget, {budget_us:.1f} µs")
    axes.set_ylim(0, 1.35 * max(budget_us, float(cost_us_T.max()), 1e-9))
    axes.set_xlabel("frame (0.1 s)")
    axes.set_ylabel("µs of rays, declared")
    axes.set_title(f"Spent: {cost_us_T.mean():.1f} µs a frame on average; all rays would be {full_us:.1f}", fontsize=11)
    axes.legend(loc="upper right", ncols=2, frameon=False, fontsize=9)


def _mark_crossings(axes: Axes, terrain: Terrain, shown: Episode, *, labelled: bool) -> None:
    """Shade the frames in which the bot is where a river runs, that is, on a bridge."""
    for river in terrain.rivers:
        x0, y0, x1, y1 = river.rect
        x_T, y_T = shown.path_m[:-1].T
        inside_T = (x0 < x_T) & (x_T < x1) & (y0 < y_T) & (y_T < y1)
        edges = np.flatnonzero(np.diff(inside_T.astype(int), prepend=0, append=0))
        for begin, end in edges.reshape(-1, 2):
            axes.axvspan(begin, end, color=_DEADLY[river.kind]["facecolor"], alpha=0.45, linewidth=0, zorder=-1)
            if labelled:
                axes.text(
                    (begin + end) / 2, 0.985, f"over {river.kind}", transform=axes.get_xaxis_transform(), ha="center",
                    va="top", fontsize=8, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5},
                )  # fmt: skip


def _add(axes: Axes, rect: Rect, **style: object) -> None:
    axes.add_patch(Rectangle((rect[0], rect[1]), rect[2] - rect[0], rect[3] - rect[1], zorder=1, **style))
