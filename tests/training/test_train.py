"""The loop: it learns what to acquire, keeps within its budget, and resumes as if it had never stopped."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from tests.training import toy
from training.acquisition import rollout, sample_queries
from training.build import build_model
from training.checkpoint import load_trained
from training.config import TrainConfig
from training.traces import load_traces
from training.train import main, train
from training.update import TrainState


def test_learns_which_features_tell_the_action(dataset: Path, trained: tuple[Path, TrainState]) -> None:
    """`left` and `right` are learned to be worth their cost, `noise` and `dear` are not; γ rose from 0."""
    _, state = trained
    traces, model = load_traces(dataset), state.model
    first = slice(0, int(traces.lengths_E[0]))
    togo = traces.returns_to_go_S[first][None, :, None]
    target_cost = torch.full_like(togo, 0.2)
    with torch.no_grad():
        known = model.know(traces.free_SF[first][None], togo, target_cost, traces.costly_SD[first].float()[None])
        query, _ = sample_queries(model, known, torch.full((1, first.stop, 4), 0.5))
        sampled = rollout(model, known, query)
        push = model.action_head.actions(sampled.hidden_BTW, torch.zeros(1, first.stop, 2))[0, :, 0]
    left, right, noise, dear = sampled.probs_BTM[0].mean(0).tolist()
    assert max(noise, dear) < 0.2 < 0.5 < max(left, right)
    assert (push == traces.actions_SA[first, 0]).float().mean() > 0.8
    assert 0.0 < state.control.weights[0] <= 250 * 0.01 + 1e-9


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"budgets": (0.05, 0.3, 1.0), "control": "dual", "allocation": "frame", "frame_bots": 4},
        {"method": "iql", "budgets": (0.05, 1.0), "control": "dual"},
    ],
    ids=["algorithm-1", "conditioned", "iql"],
)
def test_a_stopped_run_resumes_to_the_same_weights(dataset: Path, tmp_path: Path, settings: dict[str, object]) -> None:
    whole = train(toy.config(dataset, tmp_path / "whole", updates=30, checkpoint_every=8, **settings))
    halves = toy.config(dataset, tmp_path / "halves", updates=30, checkpoint_every=8, **settings)
    train_interrupted(halves, after=17)
    resumed = train(halves)
    assert resumed.done == 30
    assert resumed.control.weights == whole.control.weights
    lines = [json.loads(line) for line in (tmp_path / "halves" / "metrics.jsonl").read_text().splitlines()]
    assert [line["update"] for line in lines] == [10, 20, 30]
    # Every update takes as many steps as its windows are long (one pass without memory); a mean says so even where a
    # resumed run cut it short.
    assert [line["passes"] for line in lines] == [1.0 if settings.get("method") else 12.0] * 3
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, resumed.model.state_dict()[name]), name


@pytest.mark.parametrize("allocation", ["none", "bot", "frame"])
def test_both_samplers_train_the_same_network(dataset: Path, tmp_path: Path, allocation: str) -> None:
    settings = {"allocation": allocation, "frame_bots": 4, "budgets": (0.05, 1.0), "control": "dual", "updates": 8}
    one, other = (
        train(toy.config(dataset, tmp_path / name, sampler=name, **settings)) for name in ("incremental", "parallel")
    )
    for name, value in one.model.state_dict().items():
        assert torch.allclose(value, other.model.state_dict()[name], atol=1e-4), name


def test_what_allocation_took_away_is_penalised_too(dataset: Path, tmp_path: Path) -> None:
    """Each query fits C, but what was asked for did not: φ counts it, and moves the acquisition head."""
    heads = []
    for step in (0.0, 10.0):
        settings = {"allocation": "bot", "budget": 0.2, "penalty_step": step, "updates": 10, "log_every": 10}
        state = train(toy.config(dataset, tmp_path / str(step), **settings))
        assert json.loads((tmp_path / str(step) / "metrics.jsonl").read_text())["phi"] > 0.0
        heads.append(state.model.acquisition_head.out.bias.detach().mean().item())
    assert heads[1] < heads[0]


def test_a_conditioned_network_asks_for_more_where_it_may(dataset: Path, tmp_path: Path) -> None:
    settings = {"budgets": (0.02, 0.1, 0.9), "control": "dual", "penalty_step": 0.05, "learning_rate": 5e-3}
    state = train(toy.config(dataset, tmp_path, method="rcbc", updates=500, log_every=500, **settings))
    free, togo = torch.tensor([[0.0, 5.0], [1.0, 5.0]]), torch.full((2, 1), 5.0)
    with torch.no_grad():
        asked = [
            state.model.query_probs(torch.zeros(2, 0), state.model.know(free, togo, torch.full((2, 1), c))).mean()
            for c in (0.02, 0.9)
        ]
    assert asked[1] > 1.2 * asked[0]


def train_interrupted(config: TrainConfig, after: int) -> None:
    """Ctrl-C in the middle of a run."""
    import training.train as room

    original, calls = room.update, 0

    def stopping(*arguments: object) -> None:
        nonlocal calls
        calls += 1
        if calls > after:
            raise KeyboardInterrupt
        original(*arguments)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(room, "update", stopping)
        with pytest.raises(KeyboardInterrupt):
            room.train(config)


def test_products_are_as_precise_as_the_run_says_until_it_ends(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import training.train as room

    original, seen = room.update, []

    def seeing(*arguments: object) -> None:
        seen.append(torch.get_float32_matmul_precision())
        if len(seen) == 4:
            raise KeyboardInterrupt
        original(*arguments)

    monkeypatch.setattr(room, "update", seeing)
    config = toy.config(dataset, tmp_path, updates=3)
    train(config)
    with pytest.raises(KeyboardInterrupt):
        train(dataclasses.replace(config, out=tmp_path / "medium", matmul_precision="medium"))
    assert seen == ["highest"] * 3 + ["medium"]
    assert torch.get_float32_matmul_precision() == "highest"


def test_writes_what_is_needed_to_repeat_the_run(trained: tuple[Path, TrainState]) -> None:
    out, state = trained
    config = TrainConfig.read(out / "config.json")
    assert config.out == out
    assert config == load_trained(out / "checkpoint.pt").config
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["update"] for line in lines] == list(range(10, 251, 10))
    assert lines[-1]["delta"] < lines[0]["delta"]
    assert lines[-1]["held_out"] < lines[0]["held_out"]
    assert json.loads((out / "versions.json").read_text())["torch"].startswith("2.13.0")
    assert state.done == 250


def test_refuses_to_resume_with_other_settings(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path, updates=1)
    train(config)
    with pytest.raises(ValueError, match="trained with budget"):
        train(dataclasses.replace(config, budget=0.9))


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("budget", 1.5, "budget is 1.5"),
        ("held_out", 1.0, "episodes to train on"),
        ("warmup", 0, "warmup is 0"),
        ("bins", (3, 1), "2 or more for each"),
        ("width", 15, "not a multiple"),
        ("burn_in", 12, "burn_in is 12, expected 0 or more, below window"),
        ("burn_in", -1, "burn_in is -1"),
        ("n_kv_heads", 3, "n_kv_heads is 3, expected 1 or more that divide n_heads 2"),
        ("n_kv_heads", 0, "n_kv_heads is 0"),
        ("context_length", 1, "2 or more"),
        ("budgets", (0.1,), "two or more rising edges"),
        ("budgets", (0.5, 0.1), "two or more rising edges"),
        ("budgets", (0.0, 0.1), "shares above 0"),
        ("budgets", (0.2, 0.9), "budget is 0.1, expected within what is trained"),
        ("allocation", "frame", "not a multiple of frame_bots"),
    ],
)
def test_refuses_settings_that_cannot_be(dataset: Path, setting: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        toy.config(dataset, Path("nowhere"), **{setting: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bins": (3,)}, "bins has 1 numbers"),
        ({"octaves": {"left": 2}}, "octaves names .'left'., the free features are .'which', 'clock'."),
        ({"sampled": ("jmup",)}, "sampled names .'jmup'."),
    ],
)
def test_refuses_settings_for_another_action(dataset: Path, settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build_model(toy.config(dataset, Path("nowhere"), **settings), load_traces(dataset))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"dataset": "a", "out": "b", "name": "c", "lerning_rate": 1}', "lerning_rate"),
        ('{"dataset": "a", "out": "b", "name": "c", "seed": "x"}', "seed"),
        ('{"dataset": "a", "out": "b", "name": "c", "budget": 2}', "budget is 2"),
        ('{"dataset": "a"', "truncated"),
    ],
)
def test_errors_in_a_file_name_the_file(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=f"config.json: .*{message}"):
        TrainConfig.read(tmp_path / "config.json")


def test_command_line_overrides_its_configuration_file(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy.config(dataset, tmp_path / "run", updates=9).write(tmp_path / "config.json")
    main([f"--config={tmp_path / 'config.json'}", "--updates", "2", "--log-every", "1"])
    assert TrainConfig.read(tmp_path / "run" / "config.json").updates == 2
    with pytest.raises(SystemExit):
        main(["--config"])
    assert "expected one argument" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"context_length": 29, "window": 40},
            r"has 29 timesteps .* expected more than context_length 29",
        ),
        ({"device": "cuda:99"}, "device is cuda:99, expected one that this machine and torch have: "),
        ({"held_out": 0.99}, "held_out 0.99 of 40 episodes leaves none to train on"),
    ],
)
def test_what_would_end_without_a_bundle_does_not_begin(
    dataset: Path, tmp_path: Path, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        train(toy.config(dataset, tmp_path / "run", **settings))
    assert not (tmp_path / "run").exists()


def test_a_late_long_episode_is_enough_for_a_bundle(dataset: Path) -> None:
    traces = load_traces(dataset)
    longest = int(traces.lengths_E.argmax())
    assert longest >= 8
    example = traces.example
    assert len(example.returns_to_go_T) == traces.lengths_E[longest]
    assert torch.equal(example.free_TF, traces.episode(longest).free_TF)


def test_a_network_without_a_number_in_it_replaces_no_checkpoint(dataset: Path, tmp_path: Path) -> None:
    config = toy.config(dataset, tmp_path / "run", updates=40, learning_rate=900.0, checkpoint_every=1, warmup=1)
    with pytest.raises(ValueError, match=r"update \d+ has no finite gradient: try a lower learning_rate"):
        train(dataclasses.replace(config, gradient_clip=900.0))
    weights = load_trained(tmp_path / "run" / "checkpoint.pt").model.state_dict().values()
    assert all(torch.isfinite(weight).all() for weight in weights if weight.is_floating_point())
