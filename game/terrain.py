"""Maps as data: what lies where, read from JSON and validated.

This module knows nothing about pybullet, episodes or players. Metres; the origin is the centre of the map.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from pathlib import Path

import jsonschema
import msgspec

__all__ = ["Block", "Hazard", "MapError", "PoolZone", "Rect", "River", "Terrain", "Trip", "load_map", "overlaps"]

Rect = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in metres."""


class MapError(ValueError):
    """A map file that cannot be played; the message says where and why."""


class Block(msgspec.Struct, frozen=True):
    """A solid box that stands on the ground: a wall, or a ledge when it is low enough to jump onto."""

    rect: Rect
    height_m: float


class Hazard(msgspec.Struct, frozen=True):
    """Ground that kills on touch; `kind` is lava or water."""

    kind: str
    rect: Rect


class River(msgspec.Struct, frozen=True):
    """A hazard that is crossed on bridges; `standing` of its slots have one in an episode."""

    kind: str
    rect: Rect
    slots: tuple[Rect, ...]
    standing: int


class PoolZone(msgspec.Struct, frozen=True):
    """`count` square hazards of `size_m`, drawn per episode somewhere inside `zone`."""

    zone: Rect
    size_m: int
    count: int


class Trip(msgspec.Struct, frozen=True):
    """Rectangles that the start and the goal of an episode are drawn from."""

    start: Rect
    goal: Rect


class Terrain(msgspec.Struct, frozen=True):
    """One map: the part that every episode shares, and what each episode draws."""

    name: str
    size_m: tuple[int, int]
    walls: tuple[Block, ...]
    ledges: tuple[Block, ...]
    hazards: tuple[Hazard, ...]
    rivers: tuple[River, ...]
    pools: tuple[PoolZone, ...]
    trips: tuple[Trip, ...]


def load_map(name_or_path: str) -> Terrain:
    """The map called `easy` or `hard`, or the one in a JSON file of your own; MapError says what is wrong with it."""
    path = Path(name_or_path)
    if path.suffix == ".json":
        text = path.read_text()
    else:
        resource = files("game") / "maps" / f"{name_or_path}.json"
        if not resource.is_file():
            raise MapError(f"there is no map {name_or_path!r}; expected easy, hard or a path that ends in .json")
        text = resource.read_text()
    try:
        document = json.loads(text)
        jsonschema.validate(document, _schema())
    except json.JSONDecodeError as error:
        raise MapError(f"map {name_or_path} is not JSON: {error}") from error
    except jsonschema.ValidationError as error:
        raise MapError(f"map {name_or_path}, at {error.json_path}: {error.message}") from error
    terrain = msgspec.convert(document, Terrain)
    _check(terrain)
    return terrain


def overlaps(a: Rect, b: Rect, margin_m: float = 0.0) -> bool:
    """Whether two rectangles come closer than `margin_m` along both axes."""
    return (
        a[0] < b[2] + margin_m and b[0] < a[2] + margin_m and a[1] < b[3] + margin_m and b[1] < a[3] + margin_m
    )  # fmt: skip


@cache
def _schema() -> dict[str, object]:
    schema: dict[str, object] = json.loads((files("game") / "maps" / "schema.json").read_text())
    return schema


def _check(terrain: Terrain) -> None:
    """What a JSON schema cannot say: order, containment and what may not overlap."""
    half_x, half_y = terrain.size_m[0] / 2, terrain.size_m[1] / 2
    for name, rect in _rects(terrain):
        if not (rect[0] < rect[2] and rect[1] < rect[3]):
            raise MapError(f"map {terrain.name}: {name} {rect} is empty, expected x_min < x_max and y_min < y_max")
        if rect[0] < -half_x or rect[2] > half_x or rect[1] < -half_y or rect[3] > half_y:
            raise MapError(f"map {terrain.name}: {name} {rect} leaves the map of {terrain.size_m} m")
    for river in terrain.rivers:
        if river.standing > len(river.slots):
            raise MapError(f"map {terrain.name}: a river has {len(river.slots)} slots and {river.standing} bridges")
        for slot in river.slots:
            if not _crosses(slot, river.rect):
                raise MapError(f"map {terrain.name}: slot {slot} does not cross its river {river.rect} bank to bank")
    for pools in terrain.pools:
        if min(pools.zone[2] - pools.zone[0], pools.zone[3] - pools.zone[1]) < pools.size_m:
            raise MapError(f"map {terrain.name}: pool zone {pools.zone} is too small for pools of {pools.size_m} m")
    deadly = [hazard.rect for hazard in terrain.hazards] + [river.rect for river in terrain.rivers]
    for trip in terrain.trips:
        for block in (*deadly, *(wall.rect for wall in terrain.walls), *(ledge.rect for ledge in terrain.ledges)):
            if overlaps(trip.start, block, 1.0) or overlaps(trip.goal, block, 1.0):
                raise MapError(f"map {terrain.name}: a start or goal lies within 1 m of {block}")
    for ledge in terrain.ledges:
        if any(overlaps(ledge.rect, rect) for rect in deadly):
            raise MapError(f"map {terrain.name}: ledge {ledge.rect} stands in lava or water")


def _crosses(slot: Rect, river: Rect) -> bool:
    spans_x = slot[0] == river[0] and slot[2] == river[2] and river[1] <= slot[1] and slot[3] <= river[3]
    spans_y = slot[1] == river[1] and slot[3] == river[3] and river[0] <= slot[0] and slot[2] <= river[2]
    return spans_x or spans_y


def _rects(terrain: Terrain) -> list[tuple[str, Rect]]:
    rects = [("wall", wall.rect) for wall in terrain.walls] + [("ledge", ledge.rect) for ledge in terrain.ledges]
    rects += [("hazard", hazard.rect) for hazard in terrain.hazards]
    rects += [("river", river.rect) for river in terrain.rivers]
    rects += [("pool zone", zone.zone) for zone in terrain.pools]
    rects += [("start", trip.start) for trip in terrain.trips] + [("goal", trip.goal) for trip in terrain.trips]
    return rects
