"""Logs into datasets: what Minari and training read of them, and that an import is whole or not there."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import tracemalloc
from pathlib import Path
from typing import Any

import h5py
import minari
import msgspec
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from tests.training.logs import COLUMNS, LISTS, WRITERS, Log, column_map, rows, write_csv, write_json
from training.column_map import LARGEST, ColumnMap
from training.feature_map import FeatureMap, MappedFeature
from training.import_traces import ImportConfig, Imported, import_traces, main
from training.rows import SourceError
from training.traces import load_traces

ROOT = Path(__file__).resolve().parents[2]
SEVERAL = rows(3, 1, 4)


def imported(folder: Path, source: Path, columns: ColumnMap) -> tuple[Imported, minari.MinariDataset]:
    """Import a log into folder/<suffix>-v0."""
    config = ImportConfig(source, folder / f"{source.suffix[1:]}-v0", folder / "columns.json")
    config.columns.write_bytes(msgspec.json.encode(columns))
    return import_traces(config, Console(quiet=True)), minari.MinariDataset(config.out / "data")


def arrays(dataset: minari.MinariDataset) -> list[dict[str, np.ndarray]]:
    """Every array of every episode."""
    read = []
    for episode in dataset:
        observed = episode.observations if isinstance(episode.observations, dict) else {"": episode.observations}
        names = ("actions", "rewards", "terminations", "truncations")
        read.append({**observed, **{name: getattr(episode, name) for name in names}})
    return read


def assert_same(one: list[dict[str, np.ndarray]], other: list[dict[str, np.ndarray]]) -> None:
    for a, b in zip(one, other, strict=True):
        assert a.keys() == b.keys()
        for name, values in a.items():
            assert values.dtype == b[name].dtype
            np.testing.assert_array_equal(values, b[name])


NUMBERS = st.floats(-LARGEST, LARGEST, width=32)
NAMES = st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1, max_size=8)
ACTIONS = st.tuples(st.floats(-1, 1, width=32), st.floats(-(2.0**127), 2.0**127, width=32))
STEPS = st.lists(st.tuples(NUMBERS, NUMBERS, ACTIONS, NUMBERS), min_size=1, max_size=5)


@settings(max_examples=12, deadline=None)
@given(st.dictionaries(NAMES, st.tuples(STEPS, st.booleans(), st.booleans()), min_size=1, max_size=4))
def test_every_format_gives_the_arrays_that_were_logged(
    episodes: dict[str, tuple[list[tuple[Any, ...]], bool, bool]],
) -> None:
    log: Log = []
    expected = []
    for name, (steps, died, stopped) in episodes.items():
        flat = [(health, speed, turn, fire, score) for health, speed, (turn, fire), score in steps]
        for t, numbers in enumerate(flat):
            last = t == len(flat) - 1
            cells = dict(zip(("health", "speed", "turn", "fire", "score"), numbers, strict=True))
            log.append({"match": name, "tick": t, **cells, "died": last and died, "stopped": last and stopped})
        steps_TX = np.array(flat, np.float32)
        last_T = np.arange(len(steps)) == len(steps) - 1
        expected.append(
            {
                "": np.concatenate([steps_TX[:, :2], steps_TX[-1:, :2]]),
                "actions": steps_TX[:, 2:4],
                "rewards": steps_TX[:, 4],
                "terminations": last_T & died,
                "truncations": last_T & (stopped or not died),
            }
        )
    ranges = {"turn": (-1, 1), "fire": (-3e38, 3e38)}
    columns = column_map(action=[{"column": name, "low": low, "high": high} for name, (low, high) in ranges.items()])
    with tempfile.TemporaryDirectory() as folder:
        for suffix, write in WRITERS.items():
            source = write(Path(folder) / f"log{suffix}", log)
            assert_same(arrays(imported(Path(folder), source, columns)[1]), expected)


def test_lists_and_parts_are_the_same_in_both_formats_that_have_them(tmp_path: Path) -> None:
    columns = msgspec.convert({**LISTS, "action": [{"column": "stick", "size": 2, "low": -1, "high": 1}]}, ColumnMap)
    sets = [imported(tmp_path, WRITERS[s](tmp_path / f"log{s}", SEVERAL), columns)[1] for s in (".jsonl", ".parquet")]
    assert_same(arrays(sets[0]), arrays(sets[1]))
    assert arrays(sets[0])[0]["rays"].tolist() == [[0.5, 2, 3, 0], [1.5, 2, 3, 0.125], *[[2.5, 2, 3, 0.25]] * 2]
    for dataset in sets:
        assert isinstance(dataset.observation_space, spaces.Dict)
        assert {key: box.shape for key, box in dataset.observation_space.items()} == {"body": (1,), "rays": (4,)}


def test_what_minari_knows_of_a_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told, _ = imported(tmp_path, write_csv(tmp_path / "log.csv", SEVERAL), column_map(environment="Arena-v2"))
    assert (told.lengths, told.terminated, told.action_names) == ((3, 1, 4), 2, ("turn", "fire"))
    assert told.returns == (0.75, 0.75, 5.5)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    dataset = minari.load_dataset("csv-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 8)
    assert dataset.env_spec.id == "Arena-v2"
    assert dataset.env_spec.entry_point is None
    assert dataset.action_space == spaces.Box(np.float32([-1, 0]), np.float32([1, 1]))
    assert dataset.observation_space == spaces.Box(-np.inf, np.inf, (2,))
    assert all(dataset.observation_space.contains(row) for row in dataset[0].observations)
    about = dataset.storage.metadata["import"]
    assert about["source"] == "log.csv"
    assert msgspec.convert(about["columns"], ColumnMap) == column_map(environment="Arena-v2")


def test_a_range_that_is_half_told_is_completed_by_the_log(tmp_path: Path) -> None:
    columns = column_map(action=[{"column": "turn", "low": -3}, {"column": "fire", "high": 2}])
    _, dataset = imported(tmp_path, write_csv(tmp_path / "log.csv", SEVERAL), columns)
    assert dataset.action_space == spaces.Box(np.float32([-3, 0]), np.float32([1, 2]))


def test_choices_are_a_discrete_action_of_minari_and_of_training(tmp_path: Path) -> None:
    """The log has choices 0 and 1 of three; what was never taken can still be learned."""
    columns = column_map(action=[{"column": "fire", "choices": 3}])
    told, dataset = imported(tmp_path, write_csv(tmp_path / "log.csv", SEVERAL), columns)
    assert [values.tolist() for values in told.action_range] == [[0], [1]]
    assert dataset.action_space == spaces.Discrete(3)
    assert dataset[0].actions.tolist() == [0, 1, 0]
    assert dataset.action_space.contains(dataset[0].actions[1])
    features = FeatureMap((MappedFeature("health", (0,)), MappedFeature("speed", (1,), cost_us=2.0)))
    traces = load_traces(tmp_path / "csv-v0", feature_map=features)
    assert traces.actions_SA[:3].tolist() == [[0], [1], [0]]
    assert traces.layout.choices == 3


def test_training_reads_it_with_a_feature_map(tmp_path: Path) -> None:
    imported(tmp_path, write_csv(tmp_path / "log.csv", SEVERAL), column_map())
    features = FeatureMap((MappedFeature("health", (0,)), MappedFeature("speed", (1,), cost_us=2.0)))
    traces = load_traces(tmp_path / "csv-v0", feature_map=features)
    assert traces.lengths_E.tolist() == [3, 1, 4]
    assert traces.free_SF[:, 0].tolist() == [row["health"] for row in SEVERAL]
    assert traces.costly_SD[:, 0].tolist() == [row["speed"] for row in SEVERAL]
    assert traces.actions_SA.tolist() == [[row["turn"], row["fire"]] for row in SEVERAL]
    assert traces.returns_to_go_S[:3].tolist() == [0.75, 0.75, 0.5]


@pytest.mark.parametrize(
    ("log", "fields", "message"),
    [
        ([*SEVERAL, SEVERAL[0]], {}, r"log\.csv: line 10: episode 'm0' comes back"),
        (
            [*SEVERAL[:-1], SEVERAL[-1] | {"speed": "fast"}],
            {},
            "line 9: column 'speed' holds 'fast', expected a",
        ),
        ([*SEVERAL[:-1], SEVERAL[-1] | {"turn": 1.01}], {}, "line 9: column 'turn' holds 1.01, expected a number from"),
        ([*SEVERAL[:4], SEVERAL[4] | {"died": True}, *SEVERAL[5:]], {}, "line 6: column 'died' holds True, expected f"),
        ([*SEVERAL[:5], *SEVERAL[6:]], {}, "line 7: column 'tick' holds 12, expected 11: it rises by 1"),
        (SEVERAL, {"reward": "points"}, "line 1: there is no column 'points'; there are 'match', 'tick'"),
        (SEVERAL[:1], {}, "action 'fire' is 0 in every row, expected its low and high in the column map"),
    ],
)
def test_an_error_leaves_nothing_behind(tmp_path: Path, log: Log, fields: dict[str, object], message: str) -> None:
    source = write_csv(tmp_path / "log.csv", log)
    with pytest.raises(SourceError, match=message):
        imported(tmp_path, source, column_map(**fields))
    assert sorted(os.listdir(tmp_path)) == ["columns.json", "log.csv"]


@pytest.mark.parametrize("suffix", [".csv", ".jsonl"])
def test_refuses_a_log_without_rows(tmp_path: Path, suffix: str) -> None:
    source = tmp_path / f"log{suffix}"
    source.write_text(",".join(SEVERAL[0]) + "\n" if suffix == ".csv" else "\n")
    with pytest.raises(SourceError, match=f"log{suffix} has no rows, expected one or more"):
        imported(tmp_path, source, column_map())
    assert sorted(os.listdir(tmp_path)) == ["columns.json", f"log{suffix}"]


def test_replaces_nothing(tmp_path: Path) -> None:
    source = write_csv(tmp_path / "log.csv", SEVERAL)
    imported(tmp_path, source, column_map())
    data = tmp_path / "csv-v0" / "data" / "main_data.hdf5"
    before = data.read_bytes()
    with pytest.raises(ValueError, match="csv-v0 is there already"):
        imported(tmp_path, write_csv(tmp_path / "log.csv", rows(2)), column_map())
    assert data.read_bytes() == before
    (tmp_path / "jsonl-v0").symlink_to(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="jsonl-v0 is there already"):
        imported(tmp_path, write_json(tmp_path / "log.jsonl", SEVERAL), column_map())


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("arena", "such as arena-expert-v0"),
        ("arena expert-v0", "such as arena-expert-v0"),
        ("nowhere/arena-v0", "nowhere is not a folder, expected the one that arena-v0 goes into"),
    ],
)
def test_refuses_a_place_for_a_dataset(tmp_path: Path, out: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        import_traces(ImportConfig(tmp_path / "log.csv", tmp_path / out, tmp_path / "columns.json"))
    assert not os.listdir(tmp_path)


def test_arrays_are_compressed_and_hold_no_links(tmp_path: Path) -> None:
    imported(tmp_path, write_csv(tmp_path / "log.csv", SEVERAL), column_map())
    with h5py.File(tmp_path / "csv-v0" / "data" / "main_data.hdf5") as file:
        assert list(file) == ["episode_0", "episode_1", "episode_2"]
        assert file["episode_2/observations"].compression == "lzf"
        assert file["episode_2"].attrs["id"] == 2
        assert file["episode_2"].attrs["total_steps"] == 4


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Eight times the episodes, the same peak: what is held is an episode and a batch."""
    peaks = []
    for n, folder in ((3, tmp_path / "short"), (24, tmp_path / "long")):
        folder.mkdir()
        source = write_csv(folder / "log.csv", rows(*[400] * n))
        tracemalloc.start()
        imported(folder, source, column_map())
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0]


def test_the_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    write_json(Path("log.jsonl"), SEVERAL)
    Path("columns.json").write_text(json.dumps(COLUMNS))
    main(["log.jsonl", "arena-v0", "--columns", "columns.json"])
    printed = capsys.readouterr().out
    assert "arena-v0: 3 episodes (2 terminated, 1 truncated), 8 steps" in printed
    table = [line.split() for line in printed.splitlines()]
    assert ["return", "2.33333", "0.75", "5.5"] in table
    assert ["steps", "of", "an", "episode", "2.66667", "1", "4"] in table
    assert ["action", "turn", "-1", "1"] in table
    assert len(minari.MinariDataset("arena-v0/data")) == 3
    with pytest.raises(SystemExit, match="error: arena-v0 is there already"):
        main(["log.jsonl", "arena-v0", "--columns", "columns.json"])
    with pytest.raises(SystemExit, match=r"error: .*No such file or directory: 'other.json'"):
        main(["log.jsonl", "other-v0", "--columns", "other.json"])


def test_the_examples_of_the_documentation(tmp_path: Path) -> None:
    """A log and the map that follows it, twice."""
    text = (Path(__file__).parents[2] / "docs" / "importing.md").read_text(encoding="utf-8")
    maps = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    lengths = []
    for suffix, columns in zip(("csv", "jsonl"), maps, strict=True):
        (log,) = re.findall(rf"```{suffix}\n(.*?)```", text, re.DOTALL)
        source = tmp_path / f"log.{suffix}"
        source.write_text(log)
        lengths.append(imported(tmp_path, source, msgspec.json.decode(columns, type=ColumnMap))[0].lengths)
    assert lengths == [(2, 3), (2,)]


@pytest.mark.parametrize("kib", [1, 20, 200])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, kib: int) -> None:
    """`ulimit -f` refuses what a full disk would. In a process of its own: HDF5 itself would end it with a signal."""
    write_csv(tmp_path / "log.csv", rows(*[400] * 30))
    (tmp_path / "columns.json").write_bytes(msgspec.json.encode(column_map()))
    command = f"ulimit -f {kib}; exec {sys.executable} -m training.import_traces log.csv big-v0 --columns columns.json"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    run = subprocess.run(["bash", "-c", command], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert run.returncode == 1
    assert [line for line in run.stderr.splitlines() if line] == ["error: [Errno 27] File too large"]
    assert sorted(os.listdir(tmp_path)) == ["columns.json", "log.csv"]
