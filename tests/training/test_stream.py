"""Streaming: the same windows as from memory, each timestep as often as the others, in bounded memory."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training import toy
from tests.training.test_train import train_interrupted
from training.stream import Pooling, Stream
from training.traces import Traces, load_traces
from training.train import train

SMALL = Pooling(pool_mb=0.02, draws=64, seed=0)  # three row groups of the toy's ten


def rows(steps: tuple[torch.Tensor, ...]) -> list[bytes]:
    return [row.tobytes() for row in torch.cat([part.reshape(len(steps[0]), -1) for part in steps], 1).numpy()]


def known_rows(traces: Traces) -> dict[bytes, int]:
    """Every timestep of the dataset by its numbers: no two are alike."""
    all_ = (traces.free_SF, traces.costly_SD, traces.actions_SA, traces.returns_to_go_S)
    known = {row: i for i, row in enumerate(rows(all_))}
    assert len(known) == len(traces.free_SF)
    return known


def test_windows_are_windows_of_the_dataset(dataset: Path, shards: Path) -> None:
    traces, stream, chance = load_traces(dataset), Stream.open(shards, SMALL), np.random.default_rng(0)
    known, last_S = known_rows(traces), set((traces.starts_E + traces.lengths_E - 1).tolist())
    starts = set(traces.starts_E.tolist())
    for update in range(30):
        batch = toy.windows(stream.pool(update), 8, 9, chance)
        parts = (batch.free_BTF, batch.costly_BTD, batch.actions_BTA, batch.returns_to_go_BT1)
        at = np.array([known[row] for row in rows(tuple(part.flatten(0, 1) for part in parts))]).reshape(8, 9)
        valid = batch.valid_BT.bool().numpy()
        follows = np.diff(at, axis=1) == 1
        assert follows[valid[:, 1:]].all()
        assert not starts & set(at[:, 1:][valid[:, 1:]].tolist()), "a window runs into another episode"
        assert {i for i in at[valid].tolist() if i in last_S} == set(at[batch.last_BT.bool().numpy()].tolist())


def test_every_timestep_is_drawn_about_as_often(dataset: Path, shards: Path) -> None:
    """Chi-square of single timesteps over whole rounds: 1 a degree of freedom where all are drawn alike. A pool that
    stood still would be at a hundred."""
    traces, stream = load_traces(dataset), Stream.open(shards, SMALL)
    known, chance = known_rows(traces), np.random.default_rng(0)
    counts = np.zeros(len(known))
    for update in range(500):
        batch = toy.windows(stream.pool(update), 64, 1, chance)
        parts = (batch.free_BTF, batch.costly_BTD, batch.actions_BTA, batch.returns_to_go_BT1)
        for row in rows(tuple(part.flatten(0, 1) for part in parts)):
            counts[known[row]] += 1
    mean = counts.mean()
    assert ((counts - mean) ** 2 / mean).sum() / (len(counts) - 1) < 1.25
    assert 0.5 * mean < counts.min() <= counts.max() < 1.6 * mean


def test_the_pool_of_an_update_does_not_depend_on_those_before(shards: Path) -> None:
    walked = Stream.open(shards, SMALL)
    for update in range(25):
        pool = walked.pool(update)
        if update % 6 == 0:
            fresh = Stream.open(shards, SMALL).pool(update)
            one, other = (toy.windows(traces, 16, 5, np.random.default_rng(1)) for traces in (pool, fresh))
            assert torch.equal(one.costly_BTD, other.costly_BTD)


def test_memory_holds_a_few_row_groups(shards: Path) -> None:
    stream = Stream.open(shards, SMALL)
    for update in range(0, 40, 3):
        pool = stream.pool(update)
        numbers = (pool.free_SF, pool.costly_SD, pool.actions_SA, pool.returns_to_go_S)
        assert sum(part.numel() * part.element_size() for part in numbers) <= 0.6 * SMALL.pool_mb * 1e6
        assert len(pool) < 20


def test_held_out_episodes_are_never_drawn(dataset: Path, shards: Path) -> None:
    """Where the split goes through a row group as well."""
    traces = load_traces(dataset)
    for share in (0.0, 0.1, 0.3):
        kept, rest = Stream.open(shards, SMALL).split(share)
        expected = traces.split(share)
        assert (len(kept), len(rest)) == tuple(map(len, expected))
        for stream, part in zip((kept, rest), expected, strict=True):
            if not len(stream):
                continue
            allowed = {steps.costly_TD.numpy().tobytes() for steps in map(part.episode, range(len(part)))}
            for update in range(0, 30, 5):
                pool = stream.pool(update)
                drawn = {steps.costly_TD.numpy().tobytes() for steps in map(pool.episode, range(len(pool)))}
                assert drawn <= allowed


@pytest.mark.parametrize("settings", [{}, {"method": "iql", "budgets": (0.05, 1.0), "control": "dual"}])
def test_a_run_whose_traces_fit_is_the_run_in_memory(
    dataset: Path, shards: Path, tmp_path: Path, settings: dict[str, object]
) -> None:
    settings = {"updates": 20, "held_out": 0.15, **settings}
    one = train(toy.config(dataset, tmp_path / "memory", **settings))
    other = train(toy.config(shards, tmp_path / "stream", **settings))
    for name, value in one.model.state_dict().items():
        assert torch.equal(value, other.model.state_dict()[name]), name
    told = [(tmp_path / run / "metrics.jsonl").read_text().splitlines() for run in ("memory", "stream")]
    for mine, theirs in zip(*(map(json.loads, lines) for lines in told), strict=True):
        assert {**mine, "seconds": 0} == {**theirs, "seconds": 0}


def test_a_stopped_run_resumes_to_the_same_weights(shards: Path, tmp_path: Path) -> None:
    settings = {"updates": 24, "checkpoint_every": 8, "pool_mb": 0.02, "batch": 4, "window": 8}
    whole = train(toy.config(shards, tmp_path / "whole", **settings))
    halves = toy.config(shards, tmp_path / "halves", **settings)
    train_interrupted(halves, after=13)
    resumed = train(halves)
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, resumed.model.state_dict()[name]), name
    with pytest.raises(ValueError, match="trained with pool_mb"):
        train(dataclasses.replace(halves, pool_mb=0.03))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pool_mb": 0.01}, "pool_mb is 0.01, expected at least 0.012: 3 row groups of .*toy, whose largest takes"),
        ({"pool_mb": 0.0}, "pool_mb is 0.0, expected above 0"),
        ({"episodes": 5}, "episodes is 5, expected none: .*toy is a folder of shards"),
        ({"feature_map": Path("map.json")}, "feature_map is map.json, expected none"),
        ({"more_datasets": (Path("other"),)}, "more_datasets is .* expected none"),
    ],
)
def test_refuses_settings_that_do_not_fit_shards(
    shards: Path, tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        train(toy.config(shards, tmp_path, **settings))
