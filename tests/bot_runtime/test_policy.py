"""The tiny bundle's graphs really depend on every input (so that other tests mean something), and rows are separate."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bot_runtime.batch import Batch
from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.policy import Policy
from protocol.errors import BadBundle
from tests import graphs
from tests.bundles import make_bundle

READ = ("prepared_NE", "costly_ND", "query_NM", "noise_NA", "place_N", "memory")


def batch_of(bundle: Bundle, n_bots: int) -> Batch:
    """A batch whose every input is random, with a full ring."""
    manifest, random = bundle.manifest, np.random.default_rng(0)
    batch = Contexts(manifest, n_bots).batch(np.arange(n_bots))
    for array in (batch.before_NX, batch.target_cost_N1, batch.prepared_NE, batch.costly_ND, batch.memory):
        array[...] = random.normal(size=array.shape)
    batch.query_NM[...] = random.random(batch.query_NM.shape) < 0.5
    batch.noise_NA[...] = random.random(batch.noise_NA.shape)
    batch.place_N[...] = manifest.n_slots
    return batch


def acted(policy: Policy, batch: Batch) -> list[np.ndarray]:
    policy.act(batch)
    return [array.copy() for array in (batch.action_NA, batch.hidden_NW, batch.tokens)]


@pytest.mark.parametrize("name", [*READ, "keys", "values"])
def test_every_input_of_the_action_graph_matters(bundle: Bundle, name: str) -> None:
    policy, batch = Policy(bundle), batch_of(bundle, 2)
    before = acted(policy, batch)[0]
    parts = {"keys": batch.memory[:, 0], "values": batch.memory[:, 1]}
    array = parts[name] if name in parts else getattr(batch, name)
    array[...] = 1.0 - array if name == "query_NM" else array + 1
    assert np.abs(acted(policy, batch)[0] - before).max() > 1e-3


def test_an_empty_slot_holds_anything(bundle: Bundle) -> None:
    policy, batch = Policy(bundle), batch_of(bundle, 2)
    batch.place_N[...] = 1
    before = acted(policy, batch)
    batch.memory[:, :, :, :, 1:] = 100.0
    for old, new in zip(before, acted(policy, batch), strict=True):
        assert np.array_equal(old, new)


def test_the_same_past_is_the_same_wherever_the_ring_begins(bundle: Bundle) -> None:
    policy, batch, slots = Policy(bundle), batch_of(bundle, 2), bundle.manifest.n_slots
    before, memory = acted(policy, batch), batch.memory.copy()
    for turned in range(1, slots):
        batch.memory[...], batch.place_N[...] = np.roll(memory, turned, axis=4), slots + turned
        for old, new in zip(before, acted(policy, batch), strict=True):
            np.testing.assert_allclose(new, old, atol=1e-5)
        batch.place_N[...] = slots
        assert np.abs(acted(policy, batch)[0] - before[0]).max() > 1e-4


def test_rows_are_separate(bundle: Bundle) -> None:
    """In a batch of the arena's rows, in one of copies, and alone."""
    policy, contexts = Policy(bundle), Contexts(bundle.manifest, 3)
    source, batch = batch_of(bundle, 3), contexts.batch(np.arange(3))
    for name in ("before_NX", "target_cost_N1", *READ):
        getattr(batch, name)[...] = getattr(source, name)
    policy.query_probs(batch)
    probs, prepared = batch.probs_NM.copy(), batch.asked_NE.copy()
    together = acted(policy, batch)
    for slots in ([0], [1], [2], [2, 0], [0, 1], [1, 2, 0]):
        some = contexts.batch(np.array(slots))
        some.fetch_past()
        some.fetch_context()
        for name in ("acquired_NY", "noise_NA", "target_cost_N1"):
            getattr(some, name)[...] = getattr(batch, name)[slots]
        policy.query_probs(some)
        np.testing.assert_allclose(some.probs_NM, probs[slots], atol=1e-5)
        np.testing.assert_allclose(some.asked_NE, prepared[slots], atol=1e-5)
        action, hidden, tokens = acted(policy, some)
        np.testing.assert_allclose(action, together[0][slots], atol=1e-5)
        np.testing.assert_allclose(hidden, together[1][slots], atol=1e-5)
        np.testing.assert_allclose(tokens, together[2][:, :, slots], atol=1e-5)


@pytest.mark.parametrize("name", ["prepared_NE", "costly_ND", "query_NM", "noise_NA"])
def test_every_input_of_a_memoryless_action_graph_matters(memoryless: Bundle, name: str) -> None:
    policy, batch = Policy(memoryless), batch_of(memoryless, 2)
    before = acted(policy, batch)
    assert [array.size for array in before] == [2 * memoryless.manifest.action.size, 0, 0]
    assert batch.is_finite
    assert batch.finite_N.tolist() == [True, True]
    array = getattr(batch, name)
    array[...] = 1.0 - array if name == "query_NM" else array + 1
    assert np.abs(acted(policy, batch)[0] - before[0]).max() > 1e-3


@pytest.mark.parametrize("output", ["probs_NM", "asked_NE"])
@pytest.mark.parametrize("name", ["past_NW", "free_NF", "left_N1", "target_cost_N1"])
def test_every_input_of_the_acquisition_graph_matters(conditioned: Bundle, name: str, output: str) -> None:
    policy, batch = Policy(conditioned), batch_of(conditioned, 2)
    policy.query_probs(batch)
    before = getattr(batch, output).copy()
    getattr(batch, name)[...] += 1.0
    policy.query_probs(batch)
    changed = np.abs(getattr(batch, output) - before).max() > 1e-3
    assert changed == (name not in ("target_cost_N1", "past_NW") or output == "probs_NM")


def test_what_is_prepared_may_not_depend_on_the_hidden_state(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Else a turn would be felt for ever, and a context could not be rebuilt."""
    Policy(bundle).check_prepared()
    scaled = graphs._Graph.scaled
    monkeypatch.setattr(
        graphs._Graph, "scaled", lambda self, x, columns, scale: scaled(self, x, columns, np.where(scale, scale, 1.0))
    )
    with pytest.raises(BadBundle, match="prepared depends on the hidden state"):
        Bundle.load(make_bundle(tmp_path))
