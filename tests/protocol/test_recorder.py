"""Recorder: what it refuses changes nothing, what it wrote is there, whatever ends the process or fills the disk."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from protocol.errors import BadSchema, BadShape, NonFinite, OutOfRange, ProtocolError, StaleFrame, TooManyBots
from protocol.features import ActionComponent, ActionSpec, Feature, FeatureTable
from protocol.recorder import Recorder
from protocol.recording import Header, RecordingError, encode_header
from protocol.recording_reader import Ending, read_recording
from tests.protocol.recordings import HEADER, HEADER_BYTES, arguments, assert_same, records_of, write

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"episodes": []}, BadShape, "no bots"),
        ({"episodes": [1, 1]}, BadSchema, "more than once"),
        ({"episodes": [1, 2**64]}, OutOfRange, "episode 18446744073709551616"),
        ({"episodes": [1, -1]}, OutOfRange, "episode -1"),
        ({"episodes": [1, 2.0]}, BadSchema, "episodes"),
        ({"episodes": 1}, BadSchema, "episodes"),
        ({"episodes": [1]}, BadShape, r"free is float32 \[2, 3\], expected float32 \[1, 3\]"),
        ({"frame": -1}, BadSchema, "frame is -1"),
        ({"frame": 2**53 + 1}, BadSchema, "frame"),
        ({"frame": 1.5}, BadSchema, "frame"),
        ({"frame": 5}, StaleFrame, "frame 5 of episode 1 does not come after its frame 5"),
        ({"free": [[0, 0, np.nan]] * 2}, NonFinite, "goal of bot 0 is nan"),
        ({"free": [[0, 0, 0], [0, 1e300, 0]]}, NonFinite, "position of bot 1 is inf"),
        ({"free": [[0, 0, 0], [0, 101, 0]]}, OutOfRange, "position of bot 1 is 101.0, expected -100 to 100"),
        ({"free": [[0, 0, 0], [0, 0]]}, BadShape, "free"),
        ({"free": "numbers"}, BadShape, "free"),
        ({"free": [["0", "0", "0"]] * 2}, BadShape, "free"),
        ({"costly": [[0, 10, 9]] * 2}, OutOfRange, "ray_far of bot 0 is 9.0, expected 10 to 50"),
        ({"costly": np.zeros((2, 2))}, BadShape, "costly"),
        ({"acquired": np.ones((2, 2))}, BadShape, "acquired is float64"),
        ({"acquired": np.ones((2, 3), dtype=bool)}, BadShape, "acquired"),
        ({"actions": [[0, 1], [0, 0]]}, OutOfRange, "forward of bot 1 is 0.0, expected 0.5 to 1"),
        ({"actions": [[0, 1], [0, np.nan]]}, NonFinite, "forward of bot 1"),
        ({"actions": [0, 1]}, BadShape, "actions"),
        ({"rewards": [0, np.inf]}, NonFinite, "reward of bot 1"),
        ({"rewards": [0, 1.1e9]}, OutOfRange, "reward of bot 1"),
        ({"rewards": [[0, 0]]}, BadShape, "rewards"),
        ({"terminated": [0, 1]}, BadShape, "terminated is int64"),
        ({"truncated": [True]}, BadShape, "truncated"),
    ],
)
def test_a_bad_call_is_refused_and_changes_nothing(
    tmp_path: Path, changes: dict[str, Any], error: type[ProtocolError], message: str
) -> None:
    path, good = tmp_path / "a.rec", {"acquired": np.ones((2, 2), dtype=bool)}
    with Recorder(path, HEADER) as recorder:
        recorder.record(**arguments(5, [1, 2]))
        before = path.read_bytes()
        with pytest.raises(error, match=message):
            recorder.record(**(arguments(6, [1, 2]) | good | changes))
        assert path.read_bytes() == before
        recorder.record(**arguments(6, [1, 2]))
    assert [record.frame for record in records_of(path)] == [5, 6]


def test_what_is_left_out_is_everything_acquired_no_reward_and_no_end(tmp_path: Path) -> None:
    said = arguments(0, [3, 4])
    with Recorder(tmp_path / "a.rec", HEADER) as recorder:
        recorder.record([3, 4], 0, **{name: said[name].tolist() for name in ("free", "costly", "actions")})
    (record,) = records_of(tmp_path / "a.rec")
    all_said = {"acquired": np.ones((2, 2), dtype=bool), "rewards": np.zeros(2, dtype=np.float32)}
    assert_same(record, said | all_said)


def test_an_id_is_free_again_when_its_episode_has_ended(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.rec", HEADER) as recorder:
        recorder.record(**arguments(5, [1, 2], truncated=np.array([True, False])))
        recorder.record(**arguments(0, [1]))
        with pytest.raises(StaleFrame):
            recorder.record(**arguments(0, [2]))
        recorder.record(**arguments(9, [2]))
    assert [record.frame for record in records_of(tmp_path / "a.rec")] == [5, 0, 9]


def test_open_episodes_are_bounded(tmp_path: Path) -> None:
    path, half = tmp_path / "a.rec", 2**15
    header = Header(FeatureTable((Feature("speed", 1),)), ActionSpec((ActionComponent("turn", -1.0, 1.0),)))
    column = np.zeros((half, 1))
    said = {"free": column, "actions": column, "costly": np.zeros((half, 0))}
    with Recorder(path, header) as recorder:
        recorder.record(range(half), 0, **said)
        recorder.record(range(half, 2 * half), 0, **said)
        with pytest.raises(TooManyBots, match="65536 episodes are open and 1 begin"):
            recorder.record([10**6], 0, free=[[0]], actions=[[0]], costly=np.zeros((1, 0)))
        recorder.record(range(half), 1, **said, terminated=np.ones(half, dtype=bool))
        recorder.record([10**6], 0, free=[[0]], actions=[[0]], costly=np.zeros((1, 0)))
    assert sum(len(record.episodes) for record in records_of(path)) == 3 * half + 1


_OTHER = {
    "features": FeatureTable((*HEADER.features.features[:3], Feature("ray_far", 2, 7.2, 10.0, 50.0))),
    "action": ActionSpec((*HEADER.action.components[:1], ActionComponent("forward", 0.5, 1.0, 0.5))),
    "about": "another",
}


@pytest.mark.parametrize("name", _OTHER)
def test_another_header_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.rec"
    write(path)
    before = path.read_bytes()
    with pytest.raises(RecordingError, match=f"another '{name}'"):
        Recorder(path, msgspec.structs.replace(HEADER, **{name: _OTHER[name]}))
    assert path.read_bytes() == before
    with Recorder(path, HEADER) as recorder:
        assert recorder.cut_bytes == 0


def test_whole_numbers_make_the_same_header(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    whole, header = (
        Header(FeatureTable((Feature("speed", 1, one),)), ActionSpec((ActionComponent("turn", -one, one),)))
        for one in (1, 1.0)
    )
    path.write_bytes(encode_header(whole)[:-5])
    for each in (header, whole):
        Recorder(path, each).close()
    assert path.read_bytes() == encode_header(header)


@pytest.mark.parametrize(
    "data", [b"something else entirely", b"\x93BOTREC\n\x02\0\0\0", encode_header(HEADER)[:-1] + b"?"]
)
def test_a_file_that_is_something_else_is_left_alone(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(data)
    with pytest.raises(RecordingError):
        Recorder(path, HEADER)
    assert path.read_bytes() == data


def test_damage_before_whole_records_is_left_alone_and_after_them_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    write(path)
    data = path.read_bytes()
    damaged = data[: HEADER_BYTES + 50] + b"?" + data[HEADER_BYTES + 51 :]
    path.write_bytes(damaged)
    with pytest.raises(RecordingError, match=f"no record at byte {HEADER_BYTES} .its CRC is wrong., but maybe one at"):
        Recorder(path, HEADER)
    assert path.read_bytes() == damaged
    path.write_bytes(data + bytes(5000))  # what power failure leaves of a file that was being extended
    assert list(read_recording(path))[-1].session == 1
    with Recorder(path, HEADER) as recorder:
        assert recorder.cut_bytes == 5000
    assert path.read_bytes() == data


def test_two_recorders_do_not_write_one_file(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.rec", HEADER) as first:
        with pytest.raises(BlockingIOError, match="another recorder"):
            Recorder(tmp_path / "a.rec", HEADER)
        first.record(**arguments(0, [1]))
    Recorder(tmp_path / "a.rec", HEADER).close()
    assert len(records_of(tmp_path / "a.rec")) == 1


def test_closed_is_closed(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.rec", HEADER, fsync_every=1)
    recorder.record(**arguments(0, [1]))
    recorder.close()
    recorder.close()
    with pytest.raises(RecordingError, match="closed"):
        recorder.record(**arguments(1, [1]))
    with pytest.raises(ValueError, match="fsync_every"):
        Recorder(tmp_path / "a.rec", HEADER, fsync_every=0)
    with pytest.raises(OSError, match="directory"):
        Recorder(tmp_path, HEADER)


def _child(program: str, path: Path) -> subprocess.Popen[str]:
    """A process that has a recorder at `path` and runs a program with it."""
    start = "from tests.protocol.recordings import *\nimport sys, pathlib\nfrom protocol.recorder import Recorder\n"
    start += "recorder = Recorder(pathlib.Path(sys.argv[1]), HEADER)\n"
    command = [sys.executable, "-c", start + program, str(path)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def test_what_a_killed_process_said_it_recorded_is_there(tmp_path: Path) -> None:
    program = """
for frame in range(10**9):
    recorder.record(**arguments(frame, [1, 2]))
    print(frame, flush=True)
"""
    with _child(program, tmp_path / "a.rec") as child:
        assert child.stdout is not None
        said = [child.stdout.readline() for _ in range(200)]
        child.kill()
        said += child.stdout.readlines()
        last = int([line for line in said if line.endswith("\n")][-1])
    with Recorder(tmp_path / "a.rec", HEADER) as recorder:
        recorder.record(**arguments(0, [1, 2]))
    *records, after = records_of(tmp_path / "a.rec")
    assert len(records) in (last + 1, last + 2)
    for frame, record in enumerate(records):
        assert_same(record, arguments(frame, [1, 2]))
    assert after.session == 1


def test_a_full_disk_raises_closes_and_leaves_whole_records(tmp_path: Path) -> None:
    """A limit on the size of files: the system writes what still fits, then refuses."""
    program = """
import resource
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
for frame in range(10**9):
    try:
        recorder.record(**arguments(frame, [1, 2]))
    except OSError as error:
        print(frame, error.strerror)
        break
try:
    recorder.record(**arguments(frame, [1, 2]))
except ValueError as error:
    print(error)
"""
    path = tmp_path / "a.rec"
    with _child(program, path) as child:
        assert child.stdout is not None
        refused, closed = child.stdout.read().splitlines()
    n, reason = refused.split(" ", 1)
    assert reason == "File too large"
    assert "the recorder is closed" in closed
    recording = read_recording(path)
    assert [record.frame for record in recording] == list(range(int(n)))
    assert recording.tail.ending is Ending.WHOLE
    assert 4000 < path.stat().st_size < 5000
    with Recorder(path, HEADER) as recorder:
        recorder.record(**arguments(0, [1]))
    assert records_of(path)[-1].session == 1
