"""Shards: what is written is what was recorded, and what is read is checked."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol.features import Feature, FeatureTable
from tests.training import toy
from training.checkpoint import Facts
from training.datasets import TracesError
from training.feature_map import FeatureMap, MappedFeature
from training.shard import ShardWriter, read_group, step_bytes
from training.shard_index import ShardIndex, is_sharded, shard_name
from training.shards import main, write_shards
from training.steps import Layout, Steps
from training.stream import Pooling, Stream
from training.traces import Traces, load_traces

ALL = Pooling(pool_mb=1.0, draws=100, seed=0)


def everything(folder: Path) -> Traces:
    return Stream.open(folder, ALL).pool(0)


def test_shards_hold_what_the_dataset_holds(dataset: Path, shards: Path) -> None:
    traces, read = load_traces(dataset), everything(shards)
    assert is_sharded(shards)
    assert not is_sharded(dataset)
    assert (read.layout, read.lengths_E.tolist()) == (traces.layout, traces.lengths_E.tolist())
    for i in range(len(traces)):
        for mine, theirs in zip(read.episode(i), traces.episode(i), strict=True):
            assert mine.dtype == theirs.dtype
            assert torch.equal(mine, theirs), i


def test_statistics_and_facts_are_those_of_traces_in_memory(dataset: Path, shards: Path) -> None:
    traces, stream = load_traces(dataset), Stream.open(shards, ALL)
    assert stream.statistics == traces.statistics
    mine, theirs = Facts.of(stream, None), Facts.of(traces, None)
    assert (mine.features, mine.action, mine.target_return) == (theirs.features, theirs.action, theirs.target_return)
    for name, value in theirs.golden.items():
        assert torch.equal(mine.golden[name], value), name


def test_pieces_are_as_large_as_was_asked(shards: Path) -> None:
    index = ShardIndex.read(shards)
    sizes = [[group.n_steps * step_bytes(index.layout) for group in shard] for shard in index.shards]
    assert len(sizes) > 2
    assert min(map(len, sizes[:-1])) > 1
    assert max(map(max, sizes)) <= 4e3
    assert max(map(sum, sizes)) <= 10e3
    for i, shard in enumerate(index.shards):
        metadata = pq.read_metadata(shards / shard_name(i))
        rows = [metadata.row_group(j).num_rows for j in range(metadata.num_row_groups)]
        assert rows == [group.n_steps for group in shard]


def test_other_tools_read_a_row_a_timestep(dataset: Path, shards: Path) -> None:
    tables = [pq.read_table(shards / shard_name(i)) for i in range(len(ShardIndex.read(shards).shards))]
    table, traces = pa.concat_tables(tables), load_traces(dataset)
    assert np.array_equal(np.stack(table["costly"].to_numpy()), traces.costly_SD.numpy())
    assert np.array_equal(table["returns_to_go"].to_numpy(), traces.returns_to_go_S.numpy())
    assert np.array_equal(table["episode"].to_numpy(), np.repeat(np.arange(40), traces.lengths_E))


@settings(max_examples=25)
@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=12), group=st.integers(1, 20), costly=st.booleans())
def test_any_lengths_come_back(lengths: list[int], group: int, costly: bool, tmp_path_factory) -> None:
    """Many numbers as halves, or none at all; an episode that is longer than a row group has one of its own."""
    table = FeatureTable((Feature("a", 2), *([Feature("b", 300, 1.0)] if costly else [])))
    layout, chance = Layout(table, toy.ACTION), torch.Generator().manual_seed(sum(lengths))
    episodes = [
        Steps(
            torch.randn(n, 2, generator=chance),
            torch.randn(n, table.n_costly, generator=chance).to(torch.float16 if costly else torch.float32),
            torch.randn(n, 2, generator=chance),
            torch.randn(n, generator=chance),
        )
        for n in lengths
    ]
    out = tmp_path_factory.mktemp("any") / "shards"
    mb = group * step_bytes(layout) / 1e6
    index = write_shards(layout, episodes, out, shard_mb=3 * mb, group_mb=mb)
    assert max(size.n_steps for shard in index.shards for size in shard) <= max(group, *lengths)
    read = everything(out)
    assert read.lengths_E.tolist() == lengths
    for i, episode in enumerate(episodes):
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(read.episode(i), episode, strict=True))


def test_command_line_takes_several_datasets_and_a_feature_map(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    features = FeatureMap((MappedFeature("where", key="free"), MappedFeature("seen", key="costly", cost_us=1.0)))
    features.write(tmp_path / "map.json")
    arguments = [str(dataset), str(dataset), str(tmp_path / "out"), "--feature-map", str(tmp_path / "map.json")]
    main([*arguments, "--episodes", "3", "--group-mb", "0.002"])
    assert re.search(r"out: 6 episodes, \d+ timesteps in 1 shards of \d+ row groups", capsys.readouterr().out)
    traces = load_traces(dataset, dataset, episodes=3, feature_map=features)
    read = everything(tmp_path / "out")
    assert read.layout == traces.layout
    assert torch.equal(read.episode(5).costly_TD, traces.episode(5).costly_TD)
    with pytest.raises(SystemExit, match="out is there already"):
        main(arguments)


def test_what_cannot_be_read_leaves_nothing(dataset: Path, tmp_path: Path) -> None:
    traces = load_traces(dataset)

    def breaking() -> object:
        yield traces.episode(0)
        raise TracesError("episode 1 is broken")

    with pytest.raises(TracesError, match="episode 1"):
        write_shards(traces.layout, breaking(), tmp_path / "out")
    with pytest.raises(ValueError, match="no episodes"):
        write_shards(traces.layout, [], tmp_path / "out")
    with pytest.raises(ValueError, match="is not a folder"):
        write_shards(traces.layout, [traces.episode(0)], tmp_path / "nowhere" / "out")
    assert list(tmp_path.iterdir()) == []


def _with(*path: object, value: object) -> object:
    def change(index: dict) -> None:
        for key in path[:-1]:
            index = index[key]
        index[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with("form", value=2), "form is 2, expected 1"),
        (_with("shards", 0, 0, value=[10**9, 5]), "the row groups hold"),
        (_with("shards", 0, 0, value=[3, 5]), "5 episodes and 3 timesteps"),
        (_with("statistics", "free", value=[[0.0], [1.0]]), "statistics of free are of 1 numbers, expected 2"),
        (_with("statistics", "free", 1, 0, value=0.0), "expected as many scales above 0"),
        (_with("features", "features", 0, "cost_us", value=1.0), "statistics of free are of 2 numbers, expected 1"),
        (_with("colour", value="red"), "unknown field `colour`"),
    ],
)
def test_refuses_an_index_that_cannot_be(shards: Path, tmp_path: Path, change, message: str) -> None:
    index = json.loads((shards / "shards.json").read_text())
    change(index)
    (tmp_path / "shards.json").write_text(json.dumps(index))
    with pytest.raises(TracesError, match=f"shards.json: .*{message}"):
        ShardIndex.read(tmp_path)


def _rewritten(change) -> object:
    def spoil(path: Path) -> None:
        table = pq.read_table(path)
        sizes = [pq.read_metadata(path).row_group(i).num_rows for i in range(pq.read_metadata(path).num_row_groups)]
        table = change(table)
        pq.write_table(table, path, row_group_size=sizes[0])

    return spoil


def _set(name: str, row: int, value: object) -> object:
    def change(table: pa.Table) -> pa.Table:
        numbers = table[name].to_pylist()
        numbers[row] = value
        field = table.schema.field(name)
        return table.set_column(table.schema.get_field_index(name), field, pa.array(numbers, field.type))

    return _rewritten(change)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(b"PAR1 and nothing else"), "row group 0: "),
        (lambda path: path.unlink(), "row group 0: "),
        (_rewritten(lambda table: table.drop_columns("free")), "columns are episode .*, expected episode"),
        (_rewritten(lambda table: table.slice(2)), "row 0 is timestep 2 of episode 0"),
        (_rewritten(lambda table: table.slice(0, 5)), "row group 0: 5 rows, expected"),
        (_set("timestep", 3, 9), "row 3 is timestep 9 of episode 0, expected what follows"),
        (_set("episode", 3, 1), "row 3 is timestep 3 of episode 1"),
        (_set("returns_to_go", 2, float("nan")), "column 'returns_to_go' has numbers that are not finite"),
        (_set("costly", 2, [float("inf")] * 7), "column 'costly' has numbers that are not finite"),
    ],
    ids=["text", "gone", "column", "cut", "short", "timestep", "episode", "nan", "inf"],
)
def test_refuses_a_shard_that_is_not_what_the_index_says(shards: Path, tmp_path: Path, spoil, message: str) -> None:
    folder = tmp_path / "shards"
    shutil.copytree(shards, folder)
    spoil(folder / shard_name(0))
    with pytest.raises(TracesError, match=message):
        everything(folder)


@pytest.mark.parametrize(
    ("lengths", "message"),
    [
        ([70] * 9, "column 'costly' has 630 numbers, expected 63"),
        ([6, 8, 7, 7, 7, 7, 7, 7, 7], "row group 0: .*all lists"),
    ],
    ids=["longer", "uneven"],
)
def test_a_schema_that_promises_other_lists_is_not_believed(tmp_path: Path, lengths: list[int], message: str) -> None:
    layout = Layout(toy.FEATURES, toy.ACTION)
    episode = Steps(torch.zeros(9, 2), torch.zeros(9, 7), torch.zeros(9, 2), torch.zeros(9))
    path = tmp_path / "000000.parquet"
    writer = ShardWriter(path, layout)
    writer.write(0, [episode])
    writer.close()
    table = pq.read_table(path)
    promised = base64.b64encode(table.schema.serialize())
    kind = pa.list_(pa.field("element", pa.float32(), nullable=False))
    field = pa.field("costly", kind, nullable=False)
    lists = pa.array([[0.0] * n for n in lengths], kind)
    table = table.set_column(table.schema.get_field_index("costly"), field, lists)
    with pq.ParquetWriter(path, table.schema, store_schema=False) as file:
        file.write_table(table)
        file.add_key_value_metadata({"ARROW:schema": promised.decode()})
    with pytest.raises(TracesError, match=message):
        read_group(path, 0, layout, 9)
