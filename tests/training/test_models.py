"""What the network may and may not depend on, and incremental = windowed."""

from __future__ import annotations

import pytest
import torch

from tests.training.test_acquisition import M, batch, know, network
from training.models import BudgetedDecisionTransformer
from training.policy import _cost_waves


def hidden_states(model: BudgetedDecisionTransformer, free, costly, togo, query) -> torch.Tensor:
    return model.hiddens(know(model, free, costly, togo), query)


def test_unacquired_values_never_matter() -> None:
    model = network(1)
    free, costly, togo, uniforms, _ = batch(1, 2, 9)
    query = (uniforms < 0.5).float()
    changed = torch.where(query.index_select(-1, model.owner) == 0, costly + 100.0, costly)
    assert torch.equal(
        hidden_states(model, free, costly, togo, query), hidden_states(model, free, changed, togo, query)
    )


def test_future_and_current_values_never_change_the_query() -> None:
    model = network(2)
    free, costly, togo, _, _ = batch(2, 2, 9)
    query = torch.ones(2, 9, M)
    changed = costly.clone()
    changed[:, 5:] += 10.0
    known = know(model, free, costly, togo)
    before = model.query_probs(model.memory(hidden_states(model, free, costly, togo, query)), known)
    after = model.query_probs(model.memory(hidden_states(model, free, changed, togo, query)), known)
    assert torch.allclose(before[:, :6], after[:, :6])
    assert not torch.allclose(before[:, 6:], after[:, 6:])


@pytest.mark.parametrize(("context_length", "n_layers"), [(2, 1), (4, 2), (3, 3)])
def test_a_frame_is_felt_for_exactly_layers_times_span(context_length: int, n_layers: int) -> None:
    """With span K and L layers an input reaches L(K-1) frames ahead: what must be replayed to rebuild a context."""
    model = network(3, context_length=context_length, n_layers=n_layers)
    free, costly, togo, _, _ = batch(3, 1, 14)
    query = torch.ones(1, 14, M)
    changed = costly.clone()
    changed[:, 0] += 3.0
    difference = hidden_states(model, free, costly, togo, query) - hidden_states(model, free, changed, togo, query)
    felt = difference.abs().amax((0, 2)) > 1e-6
    reach = n_layers * (context_length - 1)
    assert felt[: reach + 1].all()
    assert not felt[reach + 1 :].any()


def test_sampled_component_follows_its_probabilities() -> None:
    model = network(0)
    hidden = torch.randn(1, 8)
    noise = torch.linspace(0, 0.9999, 2000)[:, None].expand(-1, 2)
    actions = model.action_head.actions(hidden.expand(2000, -1), noise)
    expected = torch.softmax(model.action_head.logits(hidden)[1], -1)[0, 1].item()
    assert actions[:, 1].mean().item() == pytest.approx(expected, abs=2e-3)
    assert actions[:, 0].unique().numel() == 1


def test_the_target_cost_moves_the_query_and_nothing_else() -> None:
    model = network(4)
    free, costly, togo, uniforms, _ = batch(4, 2, 6)
    query = (uniforms < 0.5).float()
    little, much = (model.know(free, togo, torch.full_like(togo, c), costly) for c in (0.01, 0.5))
    hidden = model.hiddens(little, query)
    assert torch.equal(hidden, model.hiddens(much, query))
    memory = model.memory(hidden)
    assert not torch.allclose(model.query_probs(memory, little), model.query_probs(memory, much), atol=1e-3)


def test_a_target_cost_outside_what_was_trained_is_the_nearest_that_was() -> None:
    model = network(5)
    free, costly, togo, _, _ = batch(5, 1, 3)
    memory = torch.zeros(1, 3, 8)

    def asked(c: float) -> torch.Tensor:
        return model.query_probs(memory, model.know(free, togo, torch.full_like(togo, c), costly))

    assert torch.equal(asked(0.0), asked(0.01))
    assert not torch.allclose(asked(0.02), asked(0.01), atol=1e-4)


def test_the_target_cost_is_told_on_a_logarithmic_scale() -> None:
    told = _cost_waves(torch.tensor([[0.001], [0.01], [0.1], [1.0], [2.0]]), 0.01, 1.0)
    assert told[:, 0].tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert told[2, 1:].tolist() == pytest.approx([1.0, 0.0, 0.0, -1.0, 0.0, 1.0], abs=1e-6)
