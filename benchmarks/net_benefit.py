"""Does the network save more than it costs? µs of rays saved less µs of network and transport, by frame.

Saved is what all rays would have cost less what the bundle asked for, on recorded frames, at a table of costs; a turn
is the wall time that the engine waits, both round trips and both graphs, by `benchmarks.latency`: an engine with a core
to spare could work on meanwhile, and that is not counted. Queries are those that the bundle asks for under the costs
and budget that it declares; tables only price them. What casting takes is in neither: a ray costs what the table says.

Tables: `godot` is the paper's (2.6 to 7.9 µs a ray by range), `pybullet` was measured for this game (16 µs a call, 0.8
to 2.4 a ray), `script_6` and `script_24` are every ray at one price, the ends of what rays were found to cost from
GDScript; a bundle of another game has `declared` alone. `breakeven_bots` is the smallest number of bots from which on
the net is positive for every number that was measured, null if there is none.

    python -m benchmarks.net_benefit --out out/net-benefit
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.latency import Latency
from benchmarks.latency import measure as measure_turns
from benchmarks.recorded import RecordedFrames
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from game.rays import RANGES_M, RAYS, RayCosts, cost_model, load_costs
from protocol.features import CostModel, FeatureTable

__all__ = ["Net", "NetBenefit", "Spend", "breakeven_bots", "cost_tables", "main", "spend"]

_WIDTH = 120  # of the tables, which have a column for each number of bots
_SPEND_BOTS = 32  # that play every recorded frame, each with a seed of its own


@dataclass(frozen=True)
class NetBenefit:
    """Compare rays saved with what saving them takes."""

    bundle: Path = Path("bundles/hard")
    bots: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64, 128, 256)
    turns: int = 300  # of each transport and each number of bots
    pin: bool = True  # give the server a core of its own, where there are two
    out: Path | None = None  # write the figure to this path, as .png and .svg
    json: bool = False  # print one JSON line instead of a table


@dataclass(frozen=True)
class Spend:
    """µs of rays per bot and frame at one table of costs."""

    all_us: float
    asked_us: float

    @property
    def saved_us(self) -> float:
        """What was not cast."""
        return self.all_us - self.asked_us


@dataclass(frozen=True)
class Net:
    """By transport and number of bots: µs of a turn of all of them. By table: what a bot saves in it."""

    turn_us: Mapping[str, Mapping[int, float]]
    spends: Mapping[str, Spend]

    def us(self, transport: str, table: str, bots: int) -> float:
        """µs of a frame that are left of what all its bots save."""
        return bots * self.spends[table].saved_us - self.turn_us[transport][bots]


def cost_tables(features: FeatureTable) -> dict[str, CostModel]:
    """The tables that price this bundle's features."""
    if [feature.name for feature in features.costly] != [ray.name for ray in RAYS]:
        return {"declared": CostModel.declared(features)}
    script = {f"script_{us}": RayCosts("GDScript", 0.0, dict.fromkeys(RANGES_M, float(us))) for us in (6, 24)}
    tables = {name: load_costs(name) for name in ("godot", "pybullet")} | script
    return {name: cost_model(costs) for name, costs in tables.items()}


def spend(path: Path) -> dict[str, Spend]:
    """What a bot asks for on the recorded frames, in the mean, at every table."""
    bundle = Bundle.load(path)
    golden = read_golden((path / "golden.npz").read_bytes(), bundle.manifest)
    features = bundle.manifest.features
    frames, bots = RecordedFrames(features, golden, _SPEND_BOTS), Bots(bundle, max_bots=_SPEND_BOTS)
    handles, asked = bots.start(_SPEND_BOTS), []
    for frame in range(len(golden["free"])):
        query_NM = bots.request_queries(handles, frame, frames.free(frame)).query_NM
        bots.submit_features(handles, frame, query_NM, frames.known(frame, query_NM))
        asked.append(query_NM)
    query_XM = np.concatenate(asked)
    tables = cost_tables(features)
    return {name: Spend(costs.full_us, float(costs.query_cost_us(query_XM).mean())) for name, costs in tables.items()}


def breakeven_bots(net: Net, transport: str, table: str) -> int | None:
    """The smallest number of bots from which on the net is positive; None if the largest one still loses."""
    found = None
    for bots in sorted(net.turn_us[transport], reverse=True):
        if net.us(transport, table, bots) <= 0.0:
            break
        found = bots
    return found


def figure_of(net: Net) -> Figure:
    """Net µs per bot by number of bots, a panel a table, a line a transport."""
    figure = Figure(figsize=(3.4 * len(net.spends), 3.6), layout="constrained")
    panels = figure.subplots(1, len(net.spends), squeeze=False)[0]
    for panel, (table, spent) in zip(panels, net.spends.items(), strict=True):
        for transport, turns in net.turn_us.items():
            bots = sorted(turns)
            panel.plot(bots, [net.us(transport, table, n) / n for n in bots], marker=".", label=transport)
        panel.axhline(spent.saved_us, color="grey", linestyle=":", label="rays saved")
        panel.axhline(0.0, color="black", linewidth=0.8)
        panel.set_xscale("log", base=2)
        panel.set_yscale("symlog", linthresh=100.0)
        panel.set_title(f"{table}: {spent.asked_us:.0f} of {spent.all_us:.0f} µs asked for", fontsize="small")
        panel.set_xlabel("bots in a frame")
    panels[0].set_ylabel("net µs per bot and frame")
    panels[-1].legend(fontsize="x-small")
    return figure


def _tables(net: Net) -> list[Table]:
    shown = []
    for name, spent in net.spends.items():
        title = f"net µs a frame, {name}: {spent.asked_us:.1f} of {spent.all_us:.1f} µs asked for a bot and frame"
        table = Table(title=f"{title} (load {os.getloadavg()[0]:.1f})")
        bots = sorted(next(iter(net.turn_us.values())))
        for heading in ("transport", *map(str, bots), "breaks even"):
            table.add_column(heading, justify="left" if heading == "transport" else "right")
        for transport in net.turn_us:
            cells = (f"{net.us(transport, name, n):,.0f}" for n in bots)
            table.add_row(transport, *cells, str(breakeven_bots(net, transport, name) or "never"))
        shown.append(table)
    return shown


def main(config: NetBenefit) -> None:
    """Print the tables or the JSON line, and write the figure."""
    timed = measure_turns(Latency(config.bundle, config.bots, config.turns, config.pin), Console(stderr=True))
    turn_us = {
        transport: {bots: float(np.median(rows[:, 0])) for bots, rows in by_bots.items()}
        for transport, by_bots in timed.items()
    }
    net = Net(turn_us, spend(config.bundle))
    if config.out is not None:
        config.out.parent.mkdir(parents=True, exist_ok=True)
        figure = figure_of(net)
        figure.savefig(config.out.with_suffix(".png"), dpi=150)
        figure.savefig(config.out.with_suffix(".svg"), metadata={"Date": None})
    if not config.json:
        for table in _tables(net):
            Console(width=_WIDTH).print(table)
        return
    breakeven = {
        transport: {table: breakeven_bots(net, transport, table) for table in net.spends} for transport in turn_us
    }
    spends = {name: {"all_us": round(s.all_us, 1), "asked_us": round(s.asked_us, 1)} for name, s in net.spends.items()}
    turns = {transport: {str(n): round(us, 1) for n, us in by_bots.items()} for transport, by_bots in turn_us.items()}
    line = {"breakeven_bots": breakeven, "rays": spends, "turn_us": turns, "load": round(os.getloadavg()[0], 2)}
    print(json.dumps(line))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(NetBenefit, description=__doc__)))
