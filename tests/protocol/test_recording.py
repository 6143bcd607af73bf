"""The format of a recording and its reader: whatever happens to a file, whole records come back and no others."""

from __future__ import annotations

import os
import struct
import tempfile
import tracemalloc
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
from protocol.recording import BLOCK, MAX_RECORD_BYTES, Header, RecordingError, block, encode_header
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


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_after_the_header_yield_no_record_and_no_exception(
    tmp_path_factory: pytest.TempPathFactory, tail: bytes, sealed: bool
) -> None:
    """Also where their CRC is right."""
    path = tmp_path_factory.getbasetemp() / "any.rec"
    path.write_bytes(encode_header(HEADER) + (block(tail) if sealed else tail))
    assert records_of(path) == []


def _sealed(**changes: Any) -> bytes:
    payload = encode_record(checked_record(HEADER, 0, **arguments(3, [7, 8])), HEADER)[BLOCK.size :]
    return block(msgpack.packb({**msgpack.unpackb(payload), **changes}))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"free": b"\0" * 20}, "BAD_SHAPE: free has 20 bytes"),
        ({"free": np.full(6, np.nan, "<f4").tobytes()}, "NON_FINITE: position of bot 0"),
        ({"free": np.full(6, 101, "<f4").tobytes()}, "OUT_OF_RANGE: position of bot 0"),
        ({"values": b""}, "BAD_SHAPE: values"),
        ({"acquired": b"\x04\0"}, "beyond the last of 2 features"),
        ({"actions": np.zeros(4, "<f4").tobytes()}, "OUT_OF_RANGE: forward of bot 0"),
        ({"rewards": np.array([0, 2e9], "<f4").tobytes()}, "OUT_OF_RANGE: reward of bot 1"),
        ({"terminated": b"\x01"}, "BAD_SHAPE: actions"),
        ({"episodes": [7, 7]}, "BAD_SCHEMA: an episode is named more than once"),
        ({"episodes": []}, "BAD_SCHEMA"),
        ({"frame": 2**53 + 1}, "BAD_SCHEMA"),
        ({"session": -1}, "BAD_SCHEMA"),
        ({"colour": 1}, "BAD_SCHEMA"),
    ],
)
def test_an_intact_block_that_is_no_legal_record_is_damage_and_is_never_cut_off(
    tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    path = tmp_path / "illegal.rec"
    data = encode_header(HEADER) + _sealed(frame=1) + _sealed(**changes)
    path.write_bytes(data)
    recording = read_recording(path)
    assert len(list(recording)) == 1
    assert recording.tail.ending is Ending.DAMAGED
    assert reason in recording.tail.reason
    assert recording.tail.resumes_at == recording.tail.offset
    with pytest.raises(RecordingError, match="damaged"):
        Recorder(path, HEADER)
    assert path.read_bytes() == data


@pytest.mark.parametrize("second", [{"frame": 3}, {"frame": 2}, {"frame": 9, "session": 0}])
def test_records_out_of_order_are_damage(tmp_path: Path, second: dict[str, Any]) -> None:
    path = tmp_path / "order.rec"
    path.write_bytes(encode_header(HEADER) + _sealed(session=1) + _sealed(**{"session": 1} | second))
    assert len(records_of(path)) == 1


@pytest.mark.parametrize("length", [2**32 - 1, MAX_RECORD_BYTES + 1, MAX_RECORD_BYTES])
def test_a_hostile_length_allocates_nothing(tmp_path: Path, length: int) -> None:
    path = tmp_path / "hostile.rec"
    path.write_bytes(encode_header(HEADER) + BLOCK.pack(length, 0) + b"\x80" * 1000)
    tracemalloc.start()
    try:
        assert records_of(path) == []
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def test_a_few_bytes_that_claim_many_bots_allocate_nothing(tmp_path: Path) -> None:
    """A table of 16 million costly numbers and a record of bots that have acquired none of them."""
    wide = tuple(Feature(f"wide_{i}", 4096, 1.0) for i in range(1000))
    header = Header(FeatureTable(wide), HEADER.action)
    n = max_bots(header) + 1
    fields = {"session": 0, "frame": 0, "episodes": list(range(n)), "free": b"", "acquired": bytes(125 * n)}
    fields |= {"values": b"", "actions": bytes(8 * n), "rewards": bytes(4 * n), "terminated": b"\0", "truncated": b"\0"}
    with pytest.raises(TooLarge, match=f"{n} bots, expected {n - 1} or less"):
        decode_record(msgpack.packb(fields), header)


def test_what_looks_like_records_keeps_no_reader_busy(tmp_path: Path) -> None:
    """Every fourth byte claims a payload of 8 MiB: the search for a whole record must end."""
    path = tmp_path / "busy.rec"
    path.write_bytes(encode_header(HEADER) + b"\xff" * 8 + bytes.fromhex("00 80 80 00") * 2**22)
    recording = read_recording(path)
    assert list(recording) == []
    assert recording.tail.ending is Ending.DAMAGED
    assert recording.tail.resumes_at is not None


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


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "ends within its header"),
        (b"PK\x03\x04 something else", "not a recording"),
        (encode_header(HEADER)[:8] + b"\x02\0\0\0", "version 2, expected 1"),
        (encode_header(HEADER)[:12] + BLOCK.pack(2**21, 0), "header is not whole: it claims 2097152 bytes"),
        (encode_header(HEADER)[:12] + block(b"\xa0"), "header is not legal: BAD_SCHEMA"),
    ],
)
def test_what_is_no_recording_is_refused_with_its_reason(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "other"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=message):
        read_recording(path)
