"""A spec stands for the runs that its reader expects, each under a name of its own."""

from __future__ import annotations

import itertools
import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.sweep_run import Run
from training.sweep_spec import SweepSpec

BASE: dict[str, object] = {"dataset": "data/hard-expert-v0", "environment": "game.env:Navigation-hard-v0"}


def runs(*grid: dict[str, object], **parts: object) -> list[Run]:
    return SweepSpec(**{"out": "runs/x", "grid": list(grid), "base": BASE, **parts}).runs()


def test_a_block_is_every_combination_and_blocks_come_in_order() -> None:
    made = runs({"budget": [0.5, 0.1], "seed": [0, 1]}, {"acquisition": ["all", "none"]})
    assert [run.name for run in made] == [
        "bdt-learned-hard-expert-v0-c0_5-s0",
        "bdt-learned-hard-expert-v0-c0_5-s1",
        "bdt-learned-hard-expert-v0-c0_1-s0",
        "bdt-learned-hard-expert-v0-c0_1-s1",
        "bdt-all-hard-expert-v0-s0",
        "bdt-none-hard-expert-v0-s0",
    ]
    assert made[3].config.out == Path("runs/x/bdt-learned-hard-expert-v0-c0_1-s1")
    assert (made[3].config.budget, made[3].config.seed, made[3].config.name) == (0.1, 1, made[3].name)


def test_settings_that_are_lists_vary_as_lists_of_lists() -> None:
    (one,) = runs({"bins": [5, 3, 2]})
    assert one.config.bins == (5, 3, 2)
    assert [run.config.bins for run in runs({"bins": [[5, 3, 2], [7, 3, 2]]})] == [(5, 3, 2), (7, 3, 2)]
    assert runs({"budgets": [0.01, 0.5]})[0].name == "bdt-learned-hard-expert-v0-conditioned-s0"
    assert [run.config.budgets for run in runs({"budgets": [[], [0.01, 0.5]]})] == [(), (0.01, 0.5)]


def test_settings_of_one_key_vary_together() -> None:
    pairs = [["data/easy-expert-v0", "game.env:Navigation-easy-v0"], ["data/hard-expert-v0", "game.env:other-v0"]]
    made = runs({"dataset,environment": pairs, "seed": [0, 1]})
    assert [(run.config.dataset.name, run.config.environment, run.config.seed) for run in made] == [
        (Path(dataset).name, environment, seed) for (dataset, environment), seed in itertools.product(pairs, (0, 1))
    ]


def test_other_settings_are_in_the_name_where_they_vary() -> None:
    names = [run.name for run in runs({"control": "dual", "width": [32, 64], "learning_rate": 0.001})]
    assert names == [f"bdt-learned-hard-expert-v0-c0_1-dual-width{width}-s0" for width in (32, 64)]
    names = [run.name for run in runs({"allocation": ["none", "bot"], "bins": [[5, 3], [7, 3]]})]
    kinds = itertools.product(("none", "bot"), ("5_3", "7_3"))
    assert names == [f"bdt-learned-hard-expert-v0-c0_1-{word}-bins{bins}-s0" for word, bins in kinds]


def test_a_name_says_which_datasets_and_which_features() -> None:
    (run,) = runs(
        {
            "dataset": "halfcheetah-expert-v0",
            "more_datasets": [["halfcheetah-medium-v0"]],
            "feature_map": "maps/halfcheetah-nl.json",
            "reference_returns": [0.0, 1.0],
        }
    )
    assert run.name == "bdt-learned-halfcheetah-medium-expert-v0-c0_1-nl-s0"
    assert run.config.reference_returns == (0.0, 1.0)
    assert [path.name for path in run.config.more_datasets] == ["halfcheetah-medium-v0"]


def test_evaluations_are_those_that_fit_the_network() -> None:
    def labels(**settings: object) -> list[str]:
        return list(runs(settings)[0].evaluations)

    assert labels(budget=0.01) == ["soft-0.01", "hard-0.01"]
    assert labels(acquisition="random") == ["soft-0.1", "hard-0.1"]
    assert labels(acquisition="all", budgets=[0.01, 0.5]) == ["soft-1"]
    assert labels(acquisition="none") == ["soft-0"]
    assert labels(budgets=[0.01, 0.5], evaluate={"costs": [0.5, 0.02]}) == [
        "soft-0.5",
        "hard-0.5",
        "soft-0.02",
        "hard-0.02",
    ]
    assert labels(budget=0.01, evaluate={"kinds": ["soft"]}) == ["soft-0.01"]
    assert labels(environment="") == []


def test_evaluations_ask_for_what_their_label_says() -> None:
    (run,) = runs({"budgets": [0.01, 0.5]}, evaluate={"episodes": 7, "costs": [0.5, 0.05], "heat_map": 0.05})
    soft, hard = run.evaluations["soft-0.05"], run.evaluations["hard-0.05"]
    assert (soft.target_cost, soft.budget, soft.frame_budget) == (0.05, 1.0, None)
    assert (hard.target_cost, hard.budget, hard.frame_budget, hard.bots) == (0.05, 1.0, 0.05, 32)
    assert soft.episodes == hard.episodes == 7
    assert soft.out == run.config.out / "evaluations" / "soft-0.05.json"
    assert [label for label, asked in run.evaluations.items() if asked.heat_map] == ["soft-0.05"]
    (fixed,) = runs({"budget": 0.2})
    assert [(asked.target_cost, asked.frame_budget) for asked in fixed.evaluations.values()] == [
        (None, None),
        (None, 0.2),
    ]


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"grid": [{"lerning_rate": 1}]}, r"grid\[0\]: unknown settings \['lerning_rate'\]"),
        ({"grid": [{}, {"seed,sede": [[1, 1]]}]}, r"grid\[1\]: unknown settings \['sede'\]"),
        ({"grid": [{}], "base": {"depth": 2}}, r"base: unknown settings \['depth'\]"),
        ({"grid": [{"out": "elsewhere"}]}, r"\['out'\] is what the sweep gives"),
        ({"grid": [{"seed": [0, 0]}]}, "bdt-learned-hard-expert-v0-c0_1-s0 is asked for twice"),
        ({"grid": [{"width": 32}, {"width": 64}]}, r"grid\[1\]: .* they differ in \['width'\]"),
        ({"grid": [{"seed": "x"}]}, r"grid\[0\]: Expected `int`"),
        ({"grid": [{"budget": [0.1, 2.0]}]}, r"grid\[0\]: budget is 2.0"),
        ({"grid": [{"seed": []}]}, "seed is an empty list"),
        ({"grid": [{"seed,budget": [[1]]}]}, "seed,budget has .1., expected lists of 2 values"),
        ({"grid": [{"seed": 1, "seed,budget": [[1, 0.1]]}]}, "given twice"),
        ({"grid": [{"width": [10**60]}]}, "expected at most 64"),
        ({"grid": [{"evaluate": {"costs": [0.1, 0.1]}}]}, "all different"),
        ({"grid": [{"evaluate": {"epsodes": 1}}]}, "epsodes"),
        ({"grid": [{"evaluate": 3}]}, r"grid\[0\]: Expected `object`"),
        ({"grid": [{"budgets": [0.1, 0.5], "evaluate": {"costs": [2.0]}}]}, "target_cost is 2.0"),
        ({"grid": []}, "grid is empty"),
    ],
)
def test_refuses_what_cannot_be(parts: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        runs(**parts)


@pytest.mark.parametrize(
    ("text", "message"),
    [('{"out": "a"', "truncated"), ('{"out": "a", "grid": [], "gird": []}', "gird"), ('{"grid": []}', "out")],
)
def test_errors_in_a_file_name_the_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "spec.json").write_text(text)
    with pytest.raises(ValueError, match=f"spec.json: .*{message}"):
        SweepSpec.read(tmp_path / "spec.json")


BLOCKS = st.fixed_dictionaries(
    {},
    optional={
        "method": st.lists(st.sampled_from(["bdt", "rcbc", "bc", "iql"]), min_size=1, unique=True),
        "acquisition": st.lists(st.sampled_from(["learned", "random"]), min_size=1, unique=True),
        "dataset": st.lists(st.sampled_from(["a/easy v0", "a/..", "b/Hard.v1"]), min_size=1, unique=True),
        "budget": st.lists(st.integers(10, 500).map(lambda n: n / 1000), min_size=1, max_size=4, unique=True),
        "budgets": st.sampled_from([[], [0.01, 0.5]]),
        "control": st.lists(st.sampled_from(["algorithm-1", "dual"]), min_size=1, unique=True),
        "seed": st.lists(st.integers(0, 99), min_size=1, max_size=4, unique=True),
        "penalty_step": st.lists(st.sampled_from([0.5, 2.0, 3.0]), min_size=1, unique=True),
    },
)


@given(BLOCKS)
def test_names_are_unique_and_safe_or_refused(block: dict[str, list[object]]) -> None:
    if block.get("budgets"):
        block.setdefault("budget", [0.2])  # TrainConfig's own default need not lie between any edges
    sizes = [len(values) for name, values in block.items() if name != "budgets"]
    # A conditioned network is one for every budget: its own is only a default, and no part of its name.
    if block.get("budgets") and len(block.get("budget", [])) > 1:
        with pytest.raises(ValueError, match=r"they differ in \['budget'\]"):
            runs(block)
        return
    made = runs(json.loads(json.dumps(block)))
    names = {run.name for run in made}
    assert len(names) == len(made) == len({run.config.out for run in made}) == len({run.fingerprint() for run in made})
    assert len(made) == math.prod(sizes)
    assert all(re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,63}", name) for name in names)
