"""Every graph at every size, each beside the first bundle's."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.graphs import Graphs, main, measure, ratio
from tests.bundles import make_bundle


@pytest.fixture
def config(tmp_path: Path) -> Graphs:
    alone, shared = make_bundle(tmp_path / "alone"), make_bundle(tmp_path / "shared", n_heads=4, n_kv_heads=1)
    without = make_bundle(tmp_path / "without", context_length=1, target_cost=0.2)
    return Graphs((alone, shared, without), bots=(1, 3), rounds=2, slice_s=0.0)


def test_rows(config: Graphs) -> None:
    rows = measure(config)
    assert len({(row.bundle, row.graph, row.n_bots) for row in rows}) == len(rows) == 3 * 2 * 2
    assert all(row.us_R.shape == (2,) and (row.us_R > 0.0).all() for row in rows)
    for row in rows:
        alone = (str(config.bundles[0]), row.graph, row.n_bots)
        first = next(each for each in rows if (each.bundle, each.graph, each.n_bots) == alone)
        assert ratio(row, rows) == np.median(row.us_R / first.us_R)


def test_lines(config: Graphs, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(Graphs(config.bundles, bots=(2,), rounds=1, slice_s=0.0, json=True)) == 0
    line = json.loads(capsys.readouterr().out)
    assert set(line) == {f"{b}_{g}_2" for b in config.bundles for g in ("acquisition", "action")} | {"load"}
    assert main(config) == 0
    assert "times the first" in capsys.readouterr().out
