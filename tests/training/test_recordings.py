"""Recordings into a dataset: the same numbers and returns-to-go come out of `load_traces` as went into `Recorder`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import minari
import msgspec
import numpy as np
import pytest

from protocol.recorder import Recorder
from protocol.recording import Header, RecordingError
from protocol.recording_reader import read_recording
from tests.training import toy
from training.datasets import open_dataset
from training.recordings import RecordingsConfig, convert, main
from training.traces import load_traces

HEADER = Header(toy.FEATURES, toy.ACTION, "toy")


class Played(NamedTuple):
    """An episode of T decisions, as its bot lived it."""

    free: np.ndarray  # [T + 1, F]
    costly: np.ndarray  # [T + 1, D]
    actions: np.ndarray  # [T, A]
    rewards: np.ndarray  # [T], of each action

    def first(self, decisions: int) -> Played:
        """It, had it ended there."""
        n = decisions
        return Played(self.free[: n + 1], self.costly[: n + 1], self.actions[:n], self.rewards[:n])


def play(seed: int, length: int) -> Played:
    rng = np.random.default_rng(seed)

    def within(limits: tuple[np.ndarray, np.ndarray], rows: int) -> np.ndarray:
        return rng.uniform(*limits, (rows, len(limits[0]))).astype(np.float32)

    features = toy.FEATURES
    return Played(
        within(features.free_range, length + 1),
        within(features.costly_range, length + 1),
        within(toy.ACTION.range, length),
        rng.normal(size=length).astype(np.float32),
    )


def rows(played: dict[int, tuple[Played, int]], frame: int, **other: Any) -> dict[str, Any]:
    """Arguments of `record` for bots at these decisions; at the last one plus one their episodes end."""
    ended = [at == len(one.rewards) for one, at in played.values()]
    actions = [np.full(2, np.nan) if at == len(one.rewards) else one.actions[at] for one, at in played.values()]
    return {
        "episodes": list(played),
        "frame": frame,
        "free": np.stack([one.free[at] for one, at in played.values()]),
        "costly": np.stack([one.costly[at] for one, at in played.values()]),
        "actions": np.stack(actions),
        "rewards": np.array([0.0 if at == 0 else one.rewards[at - 1] for one, at in played.values()]),
        "terminated": np.array(ended),
    } | other


def record_together(path: Path, episodes: list[Played], seats: int = 3, header: Header = HEADER) -> list[int]:
    """Bots play side by side, and take the next episode when theirs has ended; returns the order they end in."""
    waiting, seated, frame, order = list(enumerate(episodes)), dict[int, tuple[Played, int]](), 0, []
    with Recorder(path, header, fsync_every=None) as recorder:
        while waiting or seated:
            while waiting and len(seated) < seats:
                number, one = waiting.pop(0)
                seated[number] = (one, 0)
            recorder.record(**rows(seated, frame))
            order += [number for number, (one, at) in seated.items() if at == len(one.rewards)]
            seated = {number: (one, at + 1) for number, (one, at) in seated.items() if at < len(one.rewards)}
            frame += 2  # frames may be left out
    return order


def assert_traces(out: Path, episodes: list[Played]) -> None:
    dataset, traces = open_dataset(out), load_traces(out)
    assert (dataset.features, dataset.action) == (toy.FEATURES, toy.ACTION)
    assert traces.lengths_E.tolist() == [len(one.rewards) for one in episodes]
    for one, start in zip(episodes, traces.starts_E.tolist(), strict=True):
        part = slice(start, start + len(one.rewards))
        np.testing.assert_array_equal(traces.free_SF[part].numpy(), one.free[:-1])
        np.testing.assert_allclose(traces.costly_SD[part].float().numpy(), one.costly[:-1], rtol=1e-3, atol=1e-6)
        np.testing.assert_array_equal(traces.actions_SA[part].numpy(), one.actions)
        left = [one.rewards[t:].sum(dtype=np.float64) for t in range(len(one.rewards))]
        np.testing.assert_allclose(traces.returns_to_go_S[part].numpy(), left, atol=1e-5)


def test_what_was_recorded_is_what_is_trained_on(tmp_path: Path) -> None:
    """Episodes of different lengths interleave; two recordings make one dataset."""
    first = [play(seed, 3 + seed * 7 % 11) for seed in range(8)]
    second = [play(seed, 4) for seed in range(20, 23)]
    order = record_together(tmp_path / "a.rec", first)
    assert order != sorted(order), "nothing interleaves"
    record_together(tmp_path / "b.rec", second, seats=1)
    out = tmp_path / "toy-expert-v0"
    a, b = convert(RecordingsConfig((tmp_path / "a.rec", tmp_path / "b.rec"), out))
    assert_traces(out, [first[number] for number in order] + second)
    assert (a.episodes, b.episodes, a.broken_off, a.left_out) == (8, 3, 0, 0)
    assert a.steps + b.steps == minari.MinariDataset(out / "data").total_steps
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.rec", "b.rec", "toy-expert-v0"]


def test_what_ends_an_episode_and_where_it_is_from_is_kept(tmp_path: Path) -> None:
    one, two, path = play(0, 4), play(1, 5), tmp_path / "a.rec"
    with Recorder(path, HEADER) as recorder:
        for at in range(5):
            recorder.record(**rows({0: (one, at), 1: (two, at)}, at))
        recorder.record(**rows({1: (two, 5)}, 5, terminated=np.zeros(1, bool), truncated=np.ones(1, bool)))
    out = tmp_path / "toy-expert-v0"
    convert(RecordingsConfig((path,), out))
    dataset = minari.MinariDataset(out / "data")
    terminated, truncated = dataset[0], dataset[1]
    assert terminated.terminations.tolist() == [False, False, False, True]
    assert not terminated.truncations.any()
    assert not truncated.terminations.any()
    assert truncated.truncations.tolist() == [False] * 4 + [True]
    np.testing.assert_array_equal(terminated.observations["free"], one.free)
    metadata = dataset.storage.metadata
    assert metadata["recordings"][0]["file"] == "a.rec"
    assert metadata["recordings"][0]["about"] == "toy"
    assert metadata["dataset_id"] == "toy-expert-v0"


def test_torn_anywhere_it_gives_every_decision_whose_reward_is_known(tmp_path: Path) -> None:
    episodes = [play(seed, 5) for seed in range(2)]
    record_together(tmp_path / "whole.rec", episodes, seats=2)
    data = (tmp_path / "whole.rec").read_bytes()
    torn = tmp_path / "torn.rec"
    for cut in range(len(data) - 1, len(data) // 2, -97):
        torn.write_bytes(data[:cut])
        recording = read_recording(torn)
        frames = len(list(recording))
        if frames < 2:
            break
        out = tmp_path / f"toy-torn{cut}-v0"
        (counts,) = convert(RecordingsConfig((torn,), out))
        assert (counts.ending, counts.left_out) == (recording.tail.ending.value, recording.tail.left_out)
        n = frames - 1
        assert (counts.episodes, counts.broken_off, counts.steps) == (2, 2, 2 * n)
        assert_traces(out, [one.first(n) for one in episodes])
        episode = minari.MinariDataset(out / "data")[0]
        assert episode.truncations.tolist() == [False] * (n - 1) + [True]


def test_a_new_session_ends_what_was_open_though_ids_come_again(tmp_path: Path) -> None:
    path, episodes = tmp_path / "a.rec", [play(seed, 6) for seed in range(2)]
    for one in episodes:
        with Recorder(path, HEADER) as recorder:
            for at in range(4):
                recorder.record(**rows({0: (one, at)}, at))
    out = tmp_path / "toy-expert-v0"
    (counts,) = convert(RecordingsConfig((path,), out))
    assert (counts.episodes, counts.broken_off) == (2, 2)
    assert_traces(out, [one.first(3) for one in episodes])


def test_damage_is_told_and_what_came_before_it_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episodes = [play(seed, 5) for seed in range(3)]
    record_together(tmp_path / "a.rec", episodes, seats=1)
    data = bytearray((tmp_path / "a.rec").read_bytes())
    data[len(data) * 2 // 3] ^= 1
    (tmp_path / "a.rec").write_bytes(data)
    main([str(tmp_path / "a.rec"), str(tmp_path / "toy-expert-v0")])
    said = capsys.readouterr().out
    assert "DAMAGED" in said
    assert "its CRC is wrong; there may be whole records from byte" in said
    assert 1 <= len(load_traces(tmp_path / "toy-expert-v0").lengths_E) <= 2


def test_an_action_without_all_features_is_refused_and_the_last_frame_needs_none(tmp_path: Path) -> None:
    one, path, out = play(0, 2), tmp_path / "a.rec", tmp_path / "toy-expert-v0"
    most = np.array([[True] * 4, [True, True, False, True]])
    none = np.zeros((1, 4), dtype=bool)
    with Recorder(path, HEADER) as recorder:
        for at in range(2):
            recorder.record(**rows({5: (one, at)}, at))
        recorder.record(**rows({5: (one, 2)}, 2, acquired=none))
    convert(RecordingsConfig((path,), out))
    assert_traces(out, [one])
    with Recorder(path, HEADER) as recorder:
        recorder.record(**rows({7: (one, 0), 8: (one, 0)}, 9, acquired=most))
    with pytest.raises(
        RecordingError, match=r"a.rec: frame 9 of episode 8 \(bot 1 of the record\): 3 of 4 .* noise is"
    ):
        convert(RecordingsConfig((path,), tmp_path / "toy-other-v0"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.rec", "toy-expert-v0"]


def test_what_cannot_be_converted_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    out, one = tmp_path / "toy-expert-v0", play(0, 3)
    good, empty, other = tmp_path / "good.rec", tmp_path / "empty.rec", tmp_path / "other.rec"
    record_together(good, [one])
    with Recorder(empty, HEADER) as recorder:
        recorder.record(**rows({0: (one, 0)}, 0))
    action = msgspec.structs.replace(toy.ACTION.components[0], name="pull")
    Recorder(other, Header(toy.FEATURES, msgspec.structs.replace(toy.ACTION, components=(action,)))).close()
    for recordings, into, message in (
        ((), out, "no recording to convert"),
        ((empty,), out, "no recording holds an episode with an action"),
        ((good, other), out, "other.rec has another 'action' than .*good.rec"),
        ((good,), tmp_path / "expert", "a name and a version"),
        ((good,), tmp_path / "nowhere" / "toy-expert-v0", "not a folder"),
    ):
        with pytest.raises(ValueError, match=message):
            convert(RecordingsConfig(recordings, into))
    assert not out.exists()
    convert(RecordingsConfig((good,), out))
    with pytest.raises(ValueError, match="there already"):
        convert(RecordingsConfig((good,), out))


def test_the_command_takes_many_recordings_and_says_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [str(tmp_path / f"{name}.rec") for name in "ab"]
    for path in paths:
        record_together(Path(path), [play(0, 3)])
    main([*paths, str(tmp_path / "toy-expert-v0")])
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "a.rec: 4 records, 1 episodes (0 broken off), 3 steps"
    assert said[-1] == f"{tmp_path / 'toy-expert-v0'}: 2 episodes"
    with pytest.raises(SystemExit, match=r"error: .*missing.rec"):
        main([str(tmp_path / "missing.rec"), str(tmp_path / "toy-other-v0")])


def test_the_example_of_the_documentation_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[2] / "docs" / "recording.md").read_text("utf-8")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(code, names)
    names["env"].close()
    (counts,) = convert(RecordingsConfig((Path("player.rec"),), tmp_path / "arena-player-v0"))
    assert (counts.episodes, counts.broken_off, counts.without_action) == (2, 0, 0)
    returns = load_traces(tmp_path / "arena-player-v0").episode_returns_E
    assert returns.sum() == pytest.approx(names["total"], rel=1e-5)
    assert counts.about == "Navigation-easy-v0"
