"""The net benefit: where it breaks even, what is spent, and that losing is shown as losing."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.net_benefit import Net, Spend, breakeven_bots, cost_tables, spend
from bot_runtime.bundle import Bundle
from tests.bundles import FEATURES, make_bundle


@pytest.mark.parametrize(
    ("turn_us", "breakeven"),
    [
        ({1: 10.0, 4: 10.0, 16: 10.0}, 1),
        ({1: 90.0, 4: 90.0, 16: 90.0}, 4),
        ({1: 90.0, 4: 400.0, 16: 1600.0}, None),
        ({1: 10.0, 4: 200.0, 16: 300.0}, 16),  # a lucky single bot is no promise for four
        ({1: 30.0, 4: 120.0, 16: 480.0}, None),  # as much as is saved is not more
    ],
)
def test_it_breaks_even_where_it_never_loses_again(turn_us: dict[int, float], breakeven: int | None) -> None:
    net = Net({"tcp": turn_us}, {"table": Spend(all_us=40.0, asked_us=10.0)})
    assert breakeven_bots(net, "tcp", "table") == breakeven


def test_the_net_is_what_all_bots_save_less_one_turn_of_them() -> None:
    assert Net({"tcp": {8: 100.0}}, {"table": Spend(50.0, 20.0)}).us("tcp", "table", 8) == 8 * 30.0 - 100.0


def test_rays_are_priced_by_every_table_and_other_features_by_their_own() -> None:
    assert list(cost_tables(FEATURES)) == ["declared"]
    tables = cost_tables(Bundle.load(Path("bundles/hard")).manifest.features)
    assert {name: round(costs.full_us, 1) for name, costs in tables.items()} == {
        "godot": 492.0, "pybullet": 203.6, "script_6": 576.0, "script_24": 2304.0,
    }  # fmt: skip


def test_what_the_shipped_bundle_asks_for_is_a_tenth_of_all() -> None:
    """Its manifest's target cost is 0.1; a table that prices calls makes every asking bot pay one."""
    spends = spend(Path("bundles/hard"))
    assert 0.02 < spends["godot"].asked_us / spends["godot"].all_us < 0.2
    assert spends["pybullet"].asked_us / spends["pybullet"].all_us > spends["godot"].asked_us / spends["godot"].all_us
    assert spends["script_24"].asked_us == pytest.approx(4.0 * spends["script_6"].asked_us)


def test_json_is_one_line_and_the_figure_is_written_twice(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    command = [sys.executable, "-m", "benchmarks.net_benefit", "--bundle", str(bundle), "--json", "--no-pin"]
    command += ["--bots", "1", "2", "--turns", "2", "--out", str(tmp_path / "figures" / "net")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    (printed,) = done.stdout.splitlines()
    line = json.loads(printed)
    for transport, turns in line["turn_us"].items():
        assert set(turns) == {"1", "2"}
        assert line["breakeven_bots"][transport]["declared"] in (None, 1, 2)
    assert {"inproc", "uds", "tcp", "http"} <= set(line["turn_us"])
    assert {path.suffix for path in (tmp_path / "figures").iterdir()} == {".png", ".svg"}
