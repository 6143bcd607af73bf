"""The tiny bundle's graphs really depend on every input (so that other tests mean something), and rows are separate."""

from __future__ import annotations

import numpy as np
import pytest

from bot_runtime.bundle import Bundle
from bot_runtime.policy import Cache, Policy, Step


def inputs(bundle: Bundle, n_bots: int) -> dict[str, np.ndarray]:
    manifest, random = bundle.manifest, np.random.default_rng(0)
    table, head = manifest.features, (manifest.n_heads, manifest.n_slots, manifest.head_dim)
    return {
        "free_NF": random.normal(size=(n_bots, table.n_free)),
        "costly_ND": random.normal(size=(n_bots, table.n_costly)),
        "query_NM": random.random((n_bots, table.n_queries)) < 0.5,
        "returns_to_go_N": random.normal(size=n_bots),
        "noise_NA": random.random((n_bots, manifest.action.size)),
        "keys": random.normal(size=(manifest.n_layers, n_bots, *head)),
        "values": random.normal(size=(manifest.n_layers, n_bots, *head)),
        "ages_NS": np.tile(np.arange(1, manifest.n_slots + 1), (n_bots, 1)),
    }


def act(policy: Policy, feed: dict[str, np.ndarray]) -> Step:
    rest = {name: array for name, array in feed.items() if name not in ("keys", "values")}
    return policy.act(cache=Cache(feed["keys"], feed["values"]), **rest)


@pytest.mark.parametrize(
    "name", ["free_NF", "costly_ND", "query_NM", "returns_to_go_N", "noise_NA", "keys", "values", "ages_NS"]
)
def test_every_input_of_the_action_graph_matters(bundle: Bundle, name: str) -> None:
    policy, feed = Policy(bundle), inputs(bundle, 2)
    before = act(policy, feed)
    changed = ~feed[name] if name == "query_NM" else feed[name] + 1
    after = act(policy, {**feed, name: changed})
    assert np.abs(after.action_NA - before.action_NA).max() > 1e-3


def test_an_empty_slot_holds_anything(bundle: Bundle) -> None:
    policy, feed = Policy(bundle), inputs(bundle, 2)
    feed["ages_NS"][:, 1] = bundle.manifest.context_length
    before = act(policy, feed)
    for name in ("keys", "values"):
        feed[name][:, :, :, 1] = 100.0
    for old, new in zip(before, act(policy, feed), strict=True):
        assert np.array_equal(old, new)


def test_slots_come_in_any_order(bundle: Bundle) -> None:
    policy, feed = Policy(bundle), inputs(bundle, 2)
    before = act(policy, feed)
    turned = {name: feed[name][:, :, :, ::-1] for name in ("keys", "values")}
    after = act(policy, {**feed, **turned, "ages_NS": feed["ages_NS"][:, ::-1]})
    for old, new in zip(before, after, strict=True):
        np.testing.assert_allclose(new, old, atol=1e-5)


def test_rows_are_separate(bundle: Bundle) -> None:
    policy, feed = Policy(bundle), inputs(bundle, 3)
    together = act(policy, feed)
    for row in range(3):
        by_layer = {name: feed[name][:, row : row + 1] for name in ("keys", "values")}
        alone = act(policy, {name: array[row : row + 1] for name, array in feed.items()} | by_layer)
        np.testing.assert_allclose(alone.action_NA[0], together.action_NA[row], atol=1e-5)
        np.testing.assert_allclose(alone.new_keys[:, 0], together.new_keys[:, row], atol=1e-5)


@pytest.mark.parametrize("name", ["free_NF", "costly_ND", "query_NM", "returns_to_go_N", "noise_NA"])
def test_every_input_of_a_memoryless_action_graph_matters(memoryless: Bundle, name: str) -> None:
    policy, feed = Policy(memoryless), inputs(memoryless, 2)
    before = act(policy, feed)
    assert [array.size for array in before] == [2 * memoryless.manifest.action.size, 0, 0, 0]
    assert before.finite_N.tolist() == [True, True]
    changed = ~feed[name] if name == "query_NM" else feed[name] + 1
    assert np.abs(act(policy, {**feed, name: changed}).action_NA - before.action_NA).max() > 1e-3


@pytest.mark.parametrize("name", ["hidden", "free", "returns_to_go", "target_cost"])
def test_every_input_of_the_acquisition_graph_matters(conditioned: Bundle, name: str) -> None:
    policy, manifest = Policy(conditioned), conditioned.manifest
    feed = [np.ones((1, manifest.width)), np.ones((1, manifest.features.n_free)), np.ones(1), np.zeros(1)]
    before = policy.query_probs(*feed)
    feed[["hidden", "free", "returns_to_go", "target_cost"].index(name)] += 1.0
    assert before.shape == (1, manifest.features.n_queries)
    assert np.abs(policy.query_probs(*feed) - before).max() > 1e-3
