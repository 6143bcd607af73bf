"""Δ and the action of both kinds of head, against torch's own distributions."""

from __future__ import annotations

import math

import pytest
import torch

from training.action_heads import BinsHead, GaussianHead, nearest_bins

LOW, HIGH = (-1.0, 0.0), (1.0, 4.0)


def test_bins_sum_the_components() -> None:
    head = BinsHead(3, (4, 2), LOW, HIGH, (False, False))
    torch.nn.init.zeros_(head.weight)
    torch.nn.init.zeros_(head.bias)
    losses = head.losses(torch.randn(1, 5, 3), torch.zeros(1, 5, 2))
    assert losses.shape == (1, 5)
    assert losses[0, 2].item() == pytest.approx(math.log(4) + math.log(2))


def test_nearest_bins_at_and_beyond_the_edges() -> None:
    actions = torch.tensor([[-1.0, 0.0], [1.0, 1.0], [0.09, 0.51], [7.0, -3.0]])
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 1.0])
    assert nearest_bins(actions, low, high, (11, 2)).tolist() == [[0, 0], [10, 1], [5, 1], [10, 0]]


def test_a_gaussian_is_torchs_normal_in_half_ranges() -> None:
    torch.manual_seed(0)
    head = GaussianHead(3, LOW, HIGH)
    hidden, actions = torch.randn(2, 4, 3), torch.rand(2, 4, 2) * 4.0 - 0.5
    mean, deviation = head(hidden).chunk(2, -1)
    scaled = torch.stack([actions[..., 0], actions[..., 1] / 2.0 - 1.0], -1)
    normal = torch.distributions.Normal(torch.tanh(mean), deviation.exp())
    expected = -(normal.log_prob(scaled) + 0.5 * math.log(2 * math.pi)).sum(-1)
    assert torch.allclose(head.losses(hidden, actions), expected, atol=1e-5)


def test_a_gaussian_plays_its_mean_within_the_range() -> None:
    head = GaussianHead(2, LOW, HIGH)
    hidden = 1e3 * torch.randn(200, 2, generator=torch.Generator().manual_seed(1))
    actions = head.actions(hidden, torch.rand(200, 2))
    assert (actions >= torch.tensor(LOW)).all()
    assert (actions <= torch.tensor(HIGH)).all()
    assert torch.equal(actions, head.actions(hidden, torch.rand(200, 2))), "noise does not move it"
    loss = head.losses(hidden[:1], actions[:1])
    assert (head.losses(hidden[:1], actions[:1] + 0.5) > loss).all(), "the mean is the likeliest action"


def test_certainty_is_bounded() -> None:
    """A component that never varies must not make Δ fall for ever."""
    head = GaussianHead(1, (-1.0,), (1.0,))
    with torch.no_grad():
        head.weight.zero_()
        head.bias.copy_(torch.tensor([0.0, -100.0]))
    assert head.losses(torch.zeros(1, 1), torch.zeros(1, 1)).item() == pytest.approx(-4.0)
