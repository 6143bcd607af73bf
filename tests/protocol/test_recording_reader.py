"""Reading files from anywhere: legal records in legal order come out, or a documented refusal, at a bounded cost."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.record import checked_record, encode_record
from protocol.recorder import Recorder
from protocol.recording import BLOCK, MAX_RECORD_BYTES, RecordingError, block, encode_header
from protocol.recording_reader import Ending, read_recording
from tests.protocol.recordings import HEADER, arguments, records_of


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


def test_what_looks_like_records_keeps_no_reader_busy(tmp_path: Path) -> None:
    """Every fourth byte claims a payload of 8 MiB: the search for a whole record must end."""
    path = tmp_path / "busy.rec"
    path.write_bytes(encode_header(HEADER) + b"\xff" * 8 + bytes.fromhex("00 80 80 00") * 2**22)
    recording = read_recording(path)
    assert list(recording) == []
    assert recording.tail.ending is Ending.DAMAGED
    assert recording.tail.resumes_at is not None


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
