"""Statistics of traces: means, floored deviations, and the same whatever parts they come in."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from training.statistics import Moments, Spread, Statistics, Tally
from training.steps import Steps


def spread(*parts: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    moments = Moments()
    for part in parts:
        moments.add(part)
    mean, scale = moments.spread()
    return torch.tensor(mean), torch.tensor(scale)


def test_the_mean_and_a_floored_deviation() -> None:
    x = torch.zeros(1000, 2)
    x[:, 0] = torch.linspace(-1, 1, 1000)
    x[0, 1] = 1.0  # a class seen once
    mean, scale = spread(*x.split(300))
    assert mean.tolist() == pytest.approx([0.0, 0.001], abs=1e-6)
    assert scale[0].item() == pytest.approx(x[:, 0].std(correction=0).item(), rel=1e-6)
    assert scale[1].item() == pytest.approx(0.0999, rel=1e-6)


def test_constants_can_be_divided_by() -> None:
    mean, scale = spread(*torch.tensor([[0.0, 3.0]]).expand(70_000, 2).split(999))
    assert mean.tolist() == [0.0, 3.0]
    assert scale.tolist() == [1.0, 1.0]  # what differs at play is no explosion
    assert torch.isfinite((torch.ones(2) - mean) / scale).all()


@given(st.lists(st.lists(st.floats(-1e3, 1e3, width=16), min_size=1, max_size=8), min_size=1, max_size=6))
def test_parts_tell_what_the_whole_tells(parts: list[list[float]]) -> None:
    """Against numpy, far from zero, where squares lose what deviates."""
    tensors = [torch.tensor(part).half()[:, None] for part in parts]
    whole = np.concatenate([tensor.numpy() for tensor in tensors]).astype(np.float64)
    mean, scale = spread(*(tensor.double() + 1e6 for tensor in tensors))
    expected = max(whole.std(), 0.1 * np.abs(whole - whole.mean()).max())
    assert mean.item() == pytest.approx(whole.mean() + 1e6, rel=1e-6)
    assert scale.item() == pytest.approx(expected if expected > 1e-6 else 1.0, rel=1e-5, abs=1e-6)


def test_a_tally_counts_episodes_and_the_return_to_ask_for() -> None:
    tally, chance = Tally(), np.random.default_rng(0)
    returns = chance.normal(size=30).astype(np.float32)
    for value in returns:
        togo = torch.tensor([value, 0.5])
        tally.add(Steps(torch.zeros(2, 3), torch.zeros(2, 0), torch.zeros(2, 1), togo))
    told = tally.statistics()
    assert (told.n_episodes, told.n_steps) == (30, 60)
    assert told.return_90 == pytest.approx(np.percentile(returns, 90))
    assert [len(part.mean) for part in (told.free, told.costly, told.returns_to_go)] == [3, 0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_steps": 3}, "4 episodes and 3 timesteps"),
        ({"free": Spread((0.0,), (0.0,))}, "statistics of free"),
        ({"costly": Spread((0.0, 1.0), (1.0,))}, "statistics of costly"),
        ({"returns_to_go": Spread((float("inf"),), (1.0,))}, "statistics of returns_to_go"),
        ({"return_90": float("nan")}, "return_90 is nan"),
    ],
)
def test_refuses_what_nothing_can_be_normalised_by(change: dict[str, object], message: str) -> None:
    one = Spread((0.0,), (1.0,))
    right = {"n_episodes": 4, "n_steps": 8, "free": one, "costly": one, "returns_to_go": one, "return_90": 1.0}
    Statistics(**right)
    with pytest.raises(ValueError, match=message):
        Statistics(**(right | change))
