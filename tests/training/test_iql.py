"""IQL's critics on a chain whose values are known."""

from __future__ import annotations

import pytest
import torch

from training.iql import Critics


def chain(length: int) -> tuple[torch.Tensor, ...]:
    """Two sorts of episodes: action 1 earns a reward of 1 a step, action 0 none. State: one-hot timestep."""
    state = torch.eye(length).expand(2, -1, -1)
    action = torch.tensor([0.0, 1.0])[:, None, None].expand(2, length, 1)
    rewards = action[..., 0]
    togo = rewards.flip(1).cumsum(1).flip(1)
    last = torch.zeros(2, length)
    last[:, -1] = 1.0
    return state, action, togo, last, torch.ones(2, length)


def fitted(critics: Critics, episodes: tuple[torch.Tensor, ...], updates: int) -> Critics:
    optimiser = torch.optim.Adam([p for p in critics.parameters() if p.requires_grad], lr=3e-3)
    for update in range(updates):
        optimiser.param_groups[0]["lr"] = 3e-3 * (1 - update / updates)  # else it ends wherever it swings to
        optimiser.zero_grad()
        sum(critics(*episodes)).backward()
        optimiser.step()
        critics.follow()
    return critics


def test_values_are_what_is_left_to_earn() -> None:
    torch.manual_seed(0)
    earning = tuple(part[1:] if len(part) == 2 else part for part in chain(4))
    critics = fitted(Critics(4, 1, reward_scale=2.0), earning, 800)
    expected = [sum(0.99**k for k in range(n)) / 2.0 for n in (4, 3, 2, 1)]
    assert critics.value(earning[0])[0, :, 0].tolist() == pytest.approx(expected, abs=0.003)


def test_values_and_weights_favour_the_action_that_earns() -> None:
    torch.manual_seed(0)
    episodes = chain(4)
    critics = fitted(Critics(4, 1, reward_scale=1.0), episodes, 600)
    value = critics.value(episodes[0])[0, :, 0]
    assert (value[:-1] > value[1:]).all(), "more is left to earn earlier in the chain"
    weights = critics.weights(episodes[0], episodes[1])
    assert (weights[1] > 3 * weights[0]).all()
    assert (weights <= 100.0).all()


def test_value_is_drawn_to_the_upper_end_of_the_lesser_q() -> None:
    """Eq. 5 there with τ = 0.7, by hand."""
    torch.manual_seed(0)
    state, action, togo, last, valid = chain(4)
    critics = Critics(4, 1, reward_scale=1.0)
    with torch.no_grad():
        both = torch.cat([state, action], dim=-1)
        one, other = (q(both)[..., 0] for q in critics.target_q)
        gap = torch.minimum(one, other) - critics.value(state)[..., 0]
        critics.value[-1].bias += gap.median()  # else V is on one side of all
        gap -= gap.median()
    assert (one < other).any()
    assert (other < one).any()
    expected = sum(d * d * (0.7 if d > 0 else 0.3) for d in gap.flatten().tolist()) / gap.numel()
    assert critics(state, action, togo, last, valid)[0].item() == pytest.approx(expected, rel=1e-4)
    assert critics.weights(state, action).flatten().tolist() == pytest.approx((3.0 * gap).exp().flatten().tolist())


def test_q_is_drawn_to_what_follows_and_slow_copies_judge() -> None:
    """Eq. 6 there moves no V; V and the weights read the slow copies, which follow by a twentieth."""
    torch.manual_seed(0)
    episodes = chain(4)
    critics = Critics(4, 1, reward_scale=1.0)
    critics(*episodes)[1].backward()
    assert all(parameter.grad is None or not parameter.grad.any() for parameter in critics.value.parameters())
    judged, slow = critics.weights(*episodes[:2]), critics.target_q[0][-1].bias.clone()
    with torch.no_grad():
        for q in critics.q:
            q[-1].bias += 5.0
    assert torch.equal(critics.weights(*episodes[:2]), judged)
    critics.follow()
    assert critics.target_q[0][-1].bias.item() == pytest.approx(slow.item() + 0.25, rel=1e-4)


def test_a_windows_last_timestep_without_successor_teaches_q_nothing() -> None:
    torch.manual_seed(0)
    state, action, togo, last, valid = chain(4)
    cut = torch.zeros_like(last)  # the window ends before the episode does
    critics = Critics(4, 1, reward_scale=1.0)

    def q_gradient(returns: torch.Tensor) -> torch.Tensor:
        critics.zero_grad()
        sum(critics(state, action, returns, cut, valid)).backward()
        return critics.q[0][0].weight.grad[:, 3].clone()  # what the last timestep's one-hot moves

    assert (q_gradient(togo) == 0).all()
    critics.zero_grad()
    sum(critics(state, action, togo, last, valid)).backward()
    assert (critics.q[0][0].weight.grad[:, 3] != 0).any()


def test_padding_and_rewards_after_the_end_do_not_count() -> None:
    torch.manual_seed(0)
    state, action, togo, last, valid = chain(4)
    critics = Critics(4, 1, reward_scale=1.0)
    ends = torch.zeros_like(last)
    ends[:, 1] = 1.0
    padded = valid.clone()
    padded[:, 2:] = 0.0
    other_state, other_togo = state.clone(), togo.clone()
    other_state[:, 2:] += 9.0
    other_togo[:, 2:] += 9.0
    first = sum(critics(state, action, togo, ends, padded))
    assert torch.allclose(first, sum(critics(other_state, action, other_togo, ends, padded)))
