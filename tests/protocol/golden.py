"""The golden frames of protocol/vectors, read for tests."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from protocol import vectors
from protocol.features import FeatureTable
from protocol.messages import Welcome

FOLDER = Path(vectors.__file__).parent


class Vector(NamedTuple):
    name: str
    description: dict[str, Any]
    frame: bytes

    @property
    def body(self) -> bytes:
        return self.frame[4:]

    @property
    def message(self) -> dict[str, Any]:
        return self.description["message"]


VECTORS = {
    path.stem: Vector(path.stem, json.loads(path.read_text("utf-8")), path.with_suffix(".bin").read_bytes())
    for path in sorted(FOLDER.glob("*.json"))
}
REQUESTS = [v for v in VECTORS.values() if v.description["direction"] == "request" and "message" in v.description]
REPLIES = [v for v in VECTORS.values() if v.description["direction"] == "reply"]
REFUSED = [v for v in VECTORS.values() if "refused_with" in v.description]
WELCOME = msgspec.convert(VECTORS["welcome"].message, Welcome)
TABLE: FeatureTable = WELCOME.features
BOTS = VECTORS["bots_started"].message["bots"]
