"""The 96 rays: where they point, what they cost, how their hits are encoded.

This module knows nothing about episodes, rewards or players.

`python -m game.rays --calibrate` measures what a call and a ray of each range cost on this machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from game.character import EYE_M
from game.terrain import load_map
from protocol.features import CostModel, Feature

__all__ = [
    "CLASSES",
    "RANGES_M",
    "RAYS",
    "RAY_SIZE",
    "Ray",
    "RayCosts",
    "cost_model",
    "encode",
    "load_costs",
    "ray_features",
    "segments",
]

CLASSES = ("nothing", "ground", "wall", "lava", "water")
RANGES_M = (1, 5, 10, 25, 50, 100)
RAY_SIZE = 1 + len(CLASSES)
_AZIMUTHS_DEG = tuple(range(75, -76, -10))
_PITCH_RANGE = ((50, 1), (18, 5), (8, 10), (5, 25), (3, 50), (0, 100))
"""(degrees down, metres): short rays look at the feet, long ones nearly level. From an eye at 1.2 m they meet flat
ground at 3.7, 8.5, 13.7 and 22.9 m; the first sees a ledge or wall within reach, the last sees walls."""


class Ray(NamedTuple):
    """One ray relative to the character: degrees to the left, degrees down, metres."""

    left_deg: int
    down_deg: int
    range_m: int

    @property
    def name(self) -> str:
        """Feature name: `ray_l075_d08_r010` looks 75 degrees left and 8 down, 10 m far."""
        side, tilt = "l" if self.left_deg >= 0 else "r", "d" if self.down_deg >= 0 else "u"
        return f"ray_{side}{abs(self.left_deg):03d}_{tilt}{abs(self.down_deg):02d}_r{self.range_m:03d}"


RAYS = tuple(Ray(left, down, range_m) for down, range_m in _PITCH_RANGE for left in _AZIMUTHS_DEG)

_DIRECTION_M3 = np.array(
    [
        (
            math.cos(math.radians(ray.down_deg)) * math.cos(math.radians(ray.left_deg)),
            math.cos(math.radians(ray.down_deg)) * math.sin(math.radians(ray.left_deg)),
            -math.sin(math.radians(ray.down_deg)),
        )
        for ray in RAYS
    ]
)
_RANGE_M = np.array([ray.range_m for ray in RAYS], dtype=np.float64)
_REACH_M3 = _DIRECTION_M3 * _RANGE_M[:, None]


class RayCosts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cost of rays on one machine: µs per call, and per ray by range in metres."""

    source: str
    call_us: float
    range_us: dict[int, float]


def load_costs(name_or_path: str = "godot") -> RayCosts:
    """A preset (`godot`: the paper's, `pybullet`: measured) or a JSON file; ValueError if a range is missing."""
    path = Path(name_or_path)
    text = (
        path.read_bytes() if path.suffix == ".json" else (files("game") / "costs" / f"{name_or_path}.json").read_bytes()
    )
    costs = msgspec.json.decode(text, type=RayCosts, strict=False)
    missing = [range_m for range_m in RANGES_M if range_m not in costs.range_us]
    if missing:
        raise ValueError(f"ray costs {name_or_path} lack the ranges {missing}, expected all of {RANGES_M}")
    return costs


def cost_model(costs: RayCosts) -> CostModel:
    """The costs as the protocol states them: per call and per ray, in the order of RAYS."""
    return CostModel(call_us=costs.call_us, feature_us=tuple(costs.range_us[ray.range_m] for ray in RAYS))


def ray_features(costs: RayCosts) -> tuple[Feature, ...]:
    """One feature a ray: distance in metres (a miss reads its range), then the class hit as one-hot over CLASSES."""
    return tuple(
        Feature(ray.name, RAY_SIZE, cost_us=costs.range_us[ray.range_m], low=0.0, high=float(max(ray.range_m, 1)))
        for ray in RAYS
    )


def segments(
    chosen: NDArray[np.int64], x: float, y: float, z: float, yaw: float
) -> tuple[list[list[float]], list[list[float]]]:
    """From and to points, metres, of the chosen rays for a character whose feet are at x, y, z."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    rotation_33 = np.array([(cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)])
    eye = [x, y, z + EYE_M]
    return [eye] * len(chosen), (_REACH_M3[chosen] @ rotation_33 + eye).tolist()


def encode(chosen: NDArray[np.int64], fractions: list[float], classes: NDArray[np.int64]) -> NDArray[np.float32]:
    """Values of the chosen rays in a dense vector [D]; what was not chosen is zero."""
    values_M6 = np.zeros((len(RAYS), RAY_SIZE), dtype=np.float32)
    values_M6[chosen, 0] = np.array(fractions) * _RANGE_M[chosen]
    values_M6[chosen, 1 + classes] = 1.0
    return values_M6.ravel()


@dataclass(frozen=True)
class Rays:
    """Show what rays cost, or measure it."""

    calibrate: bool = False  # measure on this machine and write the table
    map: str = "hard"  # where to measure
    out: Path = Path(__file__).parent / "costs" / "pybullet.json"  # what --calibrate writes; `pybullet` reads it
    costs: str = "godot"  # without --calibrate: the table to show


def main() -> None:
    """Command line."""
    config = tyro.cli(Rays, description=__doc__)
    if config.calibrate:
        from game.calibration import calibrate  # it needs the world, which needs this module

        costs = calibrate(load_map(config.map))
        config.out.write_bytes(msgspec.json.format(msgspec.json.encode(costs)) + b"\n")
    else:
        costs = load_costs(config.costs)
    table = Table("range m", "µs a ray", "rays", title=f"{costs.source}\n{costs.call_us:g} µs a call")
    for range_m in RANGES_M:
        table.add_row(str(range_m), f"{costs.range_us[range_m]:g}", str(sum(ray.range_m == range_m for ray in RAYS)))
    table.add_row("all", f"{cost_model(costs).full_us:.1f} µs", str(len(RAYS)))
    Console().print(table)


if __name__ == "__main__":
    main()
