"""One update: what teaches, what is penalised, and how far it may go."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.training import toy
from training.config import TrainConfig
from training.draws import draw_share
from training.iql import Critics
from training.objectives import query_cost
from training.traces import Traces, choose_windows, load_traces
from training.update import TrainState, learning_rate, new_state, update

COSTS_M = torch.tensor(toy.FEATURES.costs_us, dtype=torch.float32)


def test_while_its_memory_fills_a_window_teaches_nothing_and_moves_no_weight_of_the_cost(
    dataset: Path, tmp_path: Path
) -> None:
    config, traces = toy.config(dataset, tmp_path, burn_in=5, batch=4, control="dual"), load_traces(dataset)
    windows = choose_windows(traces, 4, 12, np.random.default_rng([0, 0]))
    index_BT, counted_BT = windows.first_B[:, None] + windows.step_BT, windows.counted_BT(5).bool().numpy()
    taught = np.unique(index_BT[counted_BT])
    burnt = np.setdiff1d(index_BT[windows.valid_BT.bool().numpy() & ~counted_BT], taught)
    assert len(burnt) >= 5
    as_recorded, other_burnt, other_taught = (
        _updated(config, _pushed_otherwise(traces, steps)) for steps in ([], burnt, taught)
    )
    for name, value in as_recorded.model.state_dict().items():
        assert torch.equal(value, other_burnt.model.state_dict()[name]), name
    assert as_recorded.metrics["delta"] != other_taught.metrics["delta"]
    drawn, fresh = draw_share(config, traces, np.random.default_rng([0, 0])), new_state(config, traces)
    cost_BT = query_cost(fresh.forward(drawn)[0].query_BTM.detach(), COSTS_M)
    assert as_recorded.metrics["cost"] == pytest.approx(cost_BT[torch.from_numpy(counted_BT)].mean().item())
    fresh.control.observe(cost_BT, drawn.target_B, drawn.stratum_B, torch.from_numpy(counted_BT).float())
    assert as_recorded.control.weights == pytest.approx(fresh.control.weights)


def test_a_window_that_burns_in_pays_for_every_query_as_much_as_those_that_count(dataset: Path, tmp_path: Path) -> None:
    traces, name = load_traces(dataset), "acquisition_head.out.bias"

    def paid(burn_in: int) -> tuple[torch.Tensor, float]:
        """What γ = 1 adds to a gradient, and the share of the timesteps that count."""
        config = toy.config(dataset, tmp_path, burn_in=burn_in, control="dual", gradient_clip=1e3)
        gradients = []
        for weight in (1.0, 2.0):
            state = new_state(config, traces)
            state.control.weights = [weight]
            update(config, state, traces, COSTS_M)
            gradients.append(dict(state.model.named_parameters())[name].grad)
        drawn = draw_share(config, traces, np.random.default_rng([0, 0]))
        return gradients[1] - gradients[0], (drawn.counted_BT.sum() / drawn.batch.valid_BT.sum()).item()

    (plain, whole), (burnt, share) = paid(0), paid(5)
    assert whole == 1.0 > share
    assert burnt.tolist() == pytest.approx((plain / share).tolist(), rel=1e-3)


def test_iql_imitates_an_action_as_much_as_it_is_worth(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, traces = toy.config(dataset, tmp_path, method="iql"), load_traces(dataset)

    def updated(worth: float) -> TrainState:
        monkeypatch.setattr(Critics, "weights", lambda *_: torch.full((config.batch, config.window), worth))
        return _updated(config, traces)

    nothing, once, thrice = updated(0.0), updated(1.0), updated(3.0)
    assert nothing.metrics["delta"] == 0.0
    assert nothing.model.action_head.weight.grad.abs().max() == 0.0
    assert once.metrics["delta"] > 0.0
    assert thrice.metrics["delta"] == pytest.approx(3.0 * once.metrics["delta"])


def test_a_gradient_is_clipped_to_its_norm(dataset: Path, tmp_path: Path) -> None:
    state = _updated(toy.config(dataset, tmp_path, gradient_clip=1e-3), load_traces(dataset))
    gradients = [parameter.grad for parameter in state.model.parameters() if parameter.grad is not None]
    assert state.metrics["gradient_norm"] > 1e-2
    assert torch.nn.utils.get_total_norm(gradients).item() == pytest.approx(1e-3, rel=1e-3)


def _pushed_otherwise(traces: Traces, steps: Sequence[int]) -> Traces:
    actions_SA = traces.actions_SA.clone()
    actions_SA[list(steps), 0] *= -1.0
    return dataclasses.replace(traces, actions_SA=actions_SA)


def _updated(config: TrainConfig, traces: Traces) -> TrainState:
    state = new_state(config, traces)
    update(config, state, traces, COSTS_M)
    return state


def test_the_learning_rate_warms_up_and_falls_to_zero() -> None:
    config = toy.config(Path("d-v0"), Path("run"), updates=100, warmup=10, learning_rate=0.5)
    rates = [learning_rate(config, done) for done in range(101)]
    assert rates[0] == pytest.approx(0.05)
    assert max(rates) == rates[9] == pytest.approx(0.5, rel=0.03)
    assert rates[50] == pytest.approx(0.25)
    assert rates[100] == pytest.approx(0.0)
