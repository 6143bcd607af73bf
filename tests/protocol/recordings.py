"""A small recording for tests: records of different lengths, episodes that end and an id that is used anew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable
from protocol.record import Record
from protocol.recorder import Recorder
from protocol.recording import Header, encode_header
from protocol.recording_reader import read_recording

__all__ = ["HEADER", "HEADER_BYTES", "arguments", "assert_same", "ends", "records_of", "write"]

HEADER = Header(
    FeatureTable(
        (
            Feature("position", 2, 0.0, -100.0, 100.0),
            Feature("ray_near", 1, 1.25, 0.0, 1.0),
            Feature("goal", 1, 0.0, -1.0, 1.0),
            Feature("ray_far", 2, 7.1, 10.0, 50.0),
        )
    ),
    ActionSpec((ActionComponent("turn", -1.0, 1.0), ActionComponent("forward", 0.5, 1.0, 0.75))),
    "toy",
)
HEADER_BYTES = len(encode_header(HEADER))


def arguments(frame: int, episodes: list[int], **other: Any) -> dict[str, Any]:
    """Legal arguments of `Recorder.record`, different in every frame; `other` replaces some."""
    rng = np.random.default_rng([frame, *episodes])
    n, features = len(episodes), HEADER.features
    said = {
        "episodes": episodes,
        "frame": frame,
        "free": rng.uniform(*features.free_range, (n, features.n_free)),
        "costly": rng.uniform(*features.costly_range, (n, features.n_costly)),
        "actions": rng.uniform(*HEADER.action.range, (n, HEADER.action.size)),
        "acquired": rng.random((n, features.n_queries)) < 0.5,
        "rewards": rng.normal(size=n),
        "terminated": np.zeros(n, dtype=bool),
        "truncated": np.zeros(n, dtype=bool),
    }
    return said | other


def write(path: Path) -> list[dict[str, Any]]:
    """Record four frames, the last one in a second session; returns what was said in each."""
    said = [
        arguments(3, [7, 2**64 - 1]),
        arguments(4, [7, 0], terminated=np.array([True, False])),
        arguments(9, [0, 7, 5], truncated=np.array([False, False, True])),
    ]
    with Recorder(path, HEADER) as recorder:
        for record in said:
            recorder.record(**record)
    again = [arguments(0, [7])]
    with Recorder(path, HEADER) as recorder:
        for record in again:
            recorder.record(**record)
    return said + again


def records_of(path: Path) -> list[Record]:
    """All whole records."""
    return list(read_recording(path))


def ends(path: Path) -> list[int]:
    """Where the header and each record end, of a file that is whole."""
    data, at, found = path.read_bytes(), HEADER_BYTES, [HEADER_BYTES]
    while at < len(data):
        at += 8 + int.from_bytes(data[at : at + 4], "little")
        found.append(at)
    return found


def assert_same(record: Record, said: dict[str, Any]) -> None:
    """A record holds what was said, to float32; what does not count reads as 0 or as the safe action."""
    ended = said["terminated"] | said["truncated"]
    known_ND = said["acquired"][:, HEADER.features.owner]
    assert record.frame == said["frame"]
    assert record.episodes.tolist() == list(said["episodes"])
    for name in ("free", "acquired", "rewards", "terminated", "truncated"):
        expected = np.asarray(said[name])
        np.testing.assert_array_equal(
            getattr(record, name), expected.astype(np.float32) if expected.dtype.kind == "f" else expected
        )
    np.testing.assert_array_equal(record.costly, np.where(known_ND, said["costly"], 0).astype(np.float32))
    expected = np.where(ended[:, None], HEADER.action.safe, said["actions"])
    np.testing.assert_array_equal(record.actions, expected.astype(np.float32))
