"""The format of a recording and its reader: whatever happens to a file, whole records come back and no others."""

from __future__ import annotations

import os
import struct
import tempfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol.errors import BadSchema, TooLarge
from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable
from protocol.record import checked_record, decode_record, encode_record, max_bots
from protocol.recorder import Recorder
from protocol.recording import BLOCK, MAX_RECORD_BYTES, Header, RecordingError, encode_header
from protocol.recording_reader import Ending, read_recording
from tests.protocol.recordings import HEADER, HEADER_BYTES, arguments, assert_same, ends, records_of, write


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    path = tmp_path_factory.mktemp("recordings") / "whole.rec"
    return path, write(path)


@pytest.fixture
def in_memory() -> Iterator[Path]:
    """A folder where a thousand fsyncs take no time, on systems that have one."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        yield Path(folder)


@st.composite
def said(draw: st.DrawFn) -> dict[str, Any]:
    n, features = draw(st.integers(1, 4)), HEADER.features

    def within(limits: tuple[np.ndarray, np.ndarray], columns: int) -> np.ndarray:
        share = draw(hnp.arrays(np.float32, (n, columns), elements=st.floats(0, 1, width=32)))
        return np.clip(limits[0] + share * (limits[1] - limits[0]), *limits)

    acquired = draw(hnp.arrays(np.bool_, (n, features.n_queries)))
    terminated, truncated = (draw(hnp.arrays(np.bool_, n)) for _ in range(2))
    costly, actions = within(features.costly_range, 3), within(HEADER.action.range, 2)
    costly[~acquired[:, features.owner]] = np.nan  # never looked at, as is the action of an episode that has ended
    actions[terminated | truncated] = np.inf
    return {
        "frame": draw(st.integers(0, 2**53)),
        "episodes": draw(st.lists(st.integers(0, 2**64 - 1), min_size=n, max_size=n, unique=True)),
        "free": within(features.free_range, 3),
        "costly": costly,
        "actions": actions,
        "acquired": acquired,
        "rewards": draw(hnp.arrays(np.float32, n, elements=st.floats(-(2.0**29), 2.0**29, width=32))),
        "terminated": terminated,
        "truncated": truncated,
    }


@settings(deadline=None)
@given(said())
def test_a_record_comes_back(said: dict[str, Any]) -> None:
    record = checked_record(HEADER, 5, **said)
    payload = encode_record(record, HEADER)[BLOCK.size :]
    back = decode_record(payload, HEADER)
    assert back.session == 5
    assert_same(back, said)


def test_all_records_come_back_in_order_as_often_as_wanted(recorded: tuple[Path, list[dict[str, Any]]]) -> None:
    path, said = recorded
    recording = read_recording(path)
    assert recording.header == HEADER
    with pytest.raises(RuntimeError, match="not been read"):
        _ = recording.tail
    for _ in range(2):
        records = list(recording)
        assert [record.session for record in records] == [0, 0, 0, 1]
        for record, expected in zip(records, said, strict=True):
            assert_same(record, expected)
    assert recording.tail == (Ending.WHOLE, path.stat().st_size, 0, None, "")


def test_the_bytes_are_those_of_the_format(recorded: tuple[Path, list[dict[str, Any]]]) -> None:
    """Read with another msgpack, by the text of protocol/recording.py alone."""
    path, said = recorded
    data = path.read_bytes()
    assert data[:12] == bytes.fromhex("93424F545245430A01000000")
    length, crc = struct.unpack("<II", data[12:20])
    header = data[20 : 20 + length]
    assert zlib.crc32(data[12:16] + header) == crc
    assert {"features", "action", "about"} == msgpack.unpackb(header).keys()
    first = HEADER_BYTES
    length, crc = struct.unpack("<II", data[first : first + 8])
    payload = data[first + 8 : first + 8 + length]
    assert zlib.crc32(data[first : first + 4] + payload) == crc
    fields = msgpack.unpackb(payload)
    assert (fields["session"], fields["frame"], fields["episodes"]) == (0, 3, [7, 2**64 - 1])
    assert fields["free"] == said[0]["free"].astype("<f4").tobytes()
    assert fields["rewards"] == said[0]["rewards"].astype("<f4").tobytes()
    assert fields["acquired"] == bytes(int(a) | int(b) << 1 for a, b in said[0]["acquired"])
    assert len(fields["values"]) == 4 * (said[0]["acquired"] @ [1, 2]).sum()
    assert (fields["terminated"], fields["truncated"]) == (b"\0", b"\0")


def test_cut_at_any_byte_the_whole_records_come_back_and_a_recorder_goes_on(
    recorded: tuple[Path, list[dict[str, Any]]], in_memory: Path
) -> None:
    path, _ = recorded
    data, whole = path.read_bytes(), ends(path)
    torn, more = in_memory / "torn.rec", arguments(2, [1])
    for cut in range(len(data) + 1):
        torn.write_bytes(data[:cut])
        n = sum(end <= cut for end in whole) - 1
        if n < 0:
            with pytest.raises(RecordingError, match="header"):
                read_recording(torn)
        else:
            recording = read_recording(torn)
            assert len(list(recording)) == n
            left_out = cut - whole[n]
            ending = Ending.TORN if left_out else Ending.WHOLE
            assert recording.tail[:4] == (ending, whole[n], left_out, None)
        with Recorder(torn, HEADER, fsync_every=None) as recorder:
            assert recorder.cut_bytes == (0 if n < 0 else cut - whole[n])
            recorder.record(**more)
        assert torn.read_bytes().startswith(data[: whole[max(n, 0)]])
        records = records_of(torn)
        assert len(records) == max(n, 0) + 1
        assert_same(records[-1], more)
        assert records[-1].session == (0 if n <= 0 else 1 if n <= 3 else 2)


def test_a_changed_byte_is_found_and_what_follows_is_told_of(
    recorded: tuple[Path, list[dict[str, Any]]], in_memory: Path
) -> None:
    path, said = recorded
    data, whole = path.read_bytes(), ends(path)
    changed = in_memory / "changed.rec"
    for place in range(HEADER_BYTES, len(data)):
        flip = (0x01, 0x80, 0xFF, 0x10)[place % 4]
        changed.write_bytes(data[:place] + bytes([data[place] ^ flip]) + data[place + 1 :])
        n = sum(end <= place for end in whole) - 1
        recording = read_recording(changed)
        for record, expected in zip(recording, said[:n], strict=True):
            assert_same(record, expected)
        tail, last = recording.tail, n == len(said) - 1
        assert (tail.offset, tail.left_out) == (whole[n], len(data) - whole[n])
        assert tail.resumes_at == (None if last else whole[n + 1])
        assert tail.ending is Ending.DAMAGED or (last and tail.ending is Ending.TORN)


def test_a_changed_header_is_refused(recorded: tuple[Path, list[dict[str, Any]]], in_memory: Path) -> None:
    data = recorded[0].read_bytes()
    changed = in_memory / "changed.rec"
    for place in range(HEADER_BYTES):
        changed.write_bytes(data[:place] + bytes([data[place] ^ 0x10]) + data[place + 1 :])
        with pytest.raises(RecordingError):
            read_recording(changed)


def test_a_few_bytes_that_claim_many_bots_allocate_nothing(tmp_path: Path) -> None:
    """A table of 16 million costly numbers and a record of bots that have acquired none of them."""
    wide = tuple(Feature(f"wide_{i}", 4096, 1.0) for i in range(1000))
    header = Header(FeatureTable(wide), HEADER.action)
    n = max_bots(header) + 1
    fields = {"session": 0, "frame": 0, "episodes": list(range(n)), "free": b"", "acquired": bytes(125 * n)}
    fields |= {"values": b"", "actions": bytes(8 * n), "rewards": bytes(4 * n), "terminated": b"\0", "truncated": b"\0"}
    with pytest.raises(TooLarge, match=f"{n} bots, expected {n - 1} or less"):
        decode_record(msgpack.packb(fields), header)


def test_a_record_is_bounded_for_its_writer_as_for_its_reader() -> None:
    header = Header(
        FeatureTable(tuple(Feature(f"wide_{i}", 4096, 1.0) for i in range(100))),
        ActionSpec((ActionComponent("turn", -1.0, 1.0),)),
    )
    n = max_bots(header)
    wide = np.zeros((n + 1, 409_600), dtype=np.float32)
    said = {"free": np.zeros((n + 1, 0)), "costly": wide, "actions": np.zeros((n + 1, 1))}
    full = checked_record(header, 0, 0, range(n), **{name: array[:n] for name, array in said.items()})
    data = encode_record(full, header)
    assert MAX_RECORD_BYTES - 2**21 < len(data) <= MAX_RECORD_BYTES
    with pytest.raises(TooLarge):
        checked_record(header, 0, 0, range(n + 1), **said)


def test_a_header_that_cannot_be_written_is_refused() -> None:
    with pytest.raises(ValueError, match="about has 4097 bytes"):
        Header(HEADER.features, HEADER.action, "é" * 2048 + "!")
    with pytest.raises(BadSchema):
        encode_header(Header("features", HEADER.action))
