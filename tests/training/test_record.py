"""The outside of a run: whose it is, and what of its metrics is kept."""

from __future__ import annotations

import dataclasses
import fcntl
import json
from pathlib import Path

import pytest

from tests.training import toy
from training.metrics import read_metrics
from training.train import train


def test_two_do_not_train_one_run(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=2)
    train(config)
    with (tmp_path / "run" / "metrics.jsonl").open("a") as lines:
        fcntl.flock(lines, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="is being trained by another process"):
            train(dataclasses.replace(config, updates=4))
    assert train(dataclasses.replace(config, updates=4)).done == 4


@pytest.mark.parametrize("line", ["null", '{"delta": 1.0}', "[1]", "nonsense"])
def test_a_line_that_is_no_metrics_is_named(dataset: Path, tmp_path: Path, line: str) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=2, log_every=1)
    train(config)
    metrics = tmp_path / "run" / "metrics.jsonl"
    with metrics.open("a") as lines:
        lines.write(line + "\n")
    with pytest.raises(ValueError, match=r"metrics\.jsonl line 3: "):
        train(dataclasses.replace(config, updates=4))
    with pytest.raises(ValueError, match=r"metrics\.jsonl line 3: "):
        read_metrics(metrics)


def test_a_run_that_goes_on_for_longer_says_so(dataset: Path, tmp_path: Path) -> None:
    """The learning rate's course was another one till then, and config.json tells the last."""
    config = toy.config(dataset, tmp_path / "run", updates=2)
    versions = tmp_path / "run" / "versions.json"
    train(config)
    assert "lengthened" not in json.loads(versions.read_text())
    for updates in (3, 5, 5):
        train(dataclasses.replace(config, updates=updates))
    assert json.loads(versions.read_text())["lengthened"] == "after update 2 of 2, after update 3 of 3"


def test_a_line_of_metrics_that_was_cut_is_dropped(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=4, log_every=1)
    train(config)
    metrics = tmp_path / "run" / "metrics.jsonl"
    metrics.write_text(metrics.read_text()[:-30])
    train(dataclasses.replace(config, updates=6))
    assert [json.loads(line)["update"] for line in metrics.read_text().splitlines()] == [1, 2, 3, 5, 6]
