"""The graphs made by hand are the network: torch over whole episodes = ONNX a turn at a time, whatever the heads."""

from __future__ import annotations

import dataclasses

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from tests.training.test_acquisition import OWNER, batch, know, network
from training.build import make_policy
from training.graphs import acquisition_graph, action_graph, reads_noise
from training.onnx_graph import OnnxGraph
from training.policy import BudgetedPolicy


def session(graph: OnnxGraph) -> ort.InferenceSession:
    return ort.InferenceSession(graph.content(), providers=["CPUExecutionProvider"])


def variant(seed: int, **changes: object) -> BudgetedPolicy:
    """The random network with another configuration; the numbers that both have are the same."""
    model = network(seed)
    other = make_policy(dataclasses.replace(model.config, **changes))
    fitting = {name: value for name, value in model.state_dict().items() if name in other.state_dict()}
    fitting = {name: value for name, value in fitting.items() if value.shape == other.state_dict()[name].shape}
    other.load_state_dict(fitting, strict=False)
    torch.nn.init.normal_(other.action_head.weight, std=1.0)
    return other.eval()


def normalise(model: BudgetedPolicy, far: bool = False) -> None:
    """Statistics as traces give them; `far`: numbers that are nearly always the same."""
    random = torch.Generator().manual_seed(1)
    for part in (model.normalise_free, model.normalise_costly, model.normalise_return):
        mean, scale = (
            torch.randn(part.mean.shape, generator=random),
            torch.rand(part.mean.shape, generator=random) + 0.3,
        )
        if far:
            mean[0], scale[0] = 4.0, 1e-3
        part.fit(mean, scale)


def largest_difference(model: BudgetedPolicy, seed: int = 0, length: int = 23, far: bool = False) -> float:
    """Of probabilities, actions and states, between the network over an episode and its graphs turn by turn."""
    config, n, slots = model.config, 3, model.config.context_length - 1
    free, costly, togo, uniforms, noise = batch(seed, n, length)
    if far:
        free[..., 0], costly[..., 0], togo[..., 0] = (4.0 + 1e-3 * torch.randn(3, n, length)).unbind()
    query = (uniforms < 0.5).float()
    with torch.no_grad():
        known = know(model, free, costly, togo)
        if not config.budget_conditioned:
            known = model.know(free, togo, torch.full_like(togo, config.target_cost), costly)
        hidden = model.hiddens(known, query)
        expected = {
            "query_probs": model.query_probs(model.memory(hidden), known),
            "action": model.action_head.actions(hidden, noise),
            "hidden": hidden,
        }
    acquisition, action = session(acquisition_graph(model)), session(action_graph(model))
    heads, head = config.token
    rings = {
        name: np.full((n, 1, heads, slots, head), 9.0, dtype=np.float32)
        for layer in range(config.n_layers if config.has_memory else 0)
        for name in (f"keys_{layer}", f"values_{layer}")
    }  # an empty slot's contents must not matter
    past, worst = np.zeros((n, model.memory_width), dtype=np.float32), 0.0
    for t in range(length):
        before = np.concatenate([past, free[:, t], togo[:, t]], axis=1)
        given = {"target_cost": known.target_cost[:, t].numpy()} if config.budget_conditioned else {}
        probs, prepared = acquisition.run(["query_probs", "prepared"], {"before": before, **given})
        owned = query[:, t][:, list(OWNER)]
        feed = {
            "prepared": prepared,
            "acquired": torch.cat([costly[:, t] * owned, query[:, t]], dim=1).numpy(),
            **rings,
        }
        if reads_noise(model):
            feed["noise"] = noise[:, t].numpy()
        if config.has_memory:
            feed["place"] = np.full(n, t if t < slots else slots + t % slots)
        names = [port.name for port in action.get_outputs()]
        got = dict(zip(names, action.run(names, feed), strict=True)) | {"query_probs": probs}
        for name in {*expected} & {*got}:
            worst = max(worst, float(np.abs(got[name] - expected[name][:, t].numpy()).max()))
        for name in rings:
            kind, layer = name.split("s_")
            rings[name][:, :, :, t % slots] = got[f"{kind}_{layer}"][:, :, :, 0]
        past = got.get("hidden", past)
    return worst


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("context_length", "n_layers"), [(4, 2), (2, 1), (9, 3)])
def test_incremental_equals_windowed_over_an_episode_longer_than_the_span(
    seed: int, context_length: int, n_layers: int
) -> None:
    model = network(seed, context_length=context_length, n_layers=n_layers)
    normalise(model)
    assert largest_difference(model, seed) <= 1e-4


@pytest.mark.parametrize("n_kv_heads", [1, 2, 4])
def test_heads_that_share_keys_and_values(n_kv_heads: int) -> None:
    """And each head keeps a bias by age of its own."""
    model = network(8, n_heads=4, n_kv_heads=n_kv_heads)
    normalise(model)
    assert model.blocks[0].attention.bias().shape == (4, 5)
    assert largest_difference(model, 8) <= 1e-4


@pytest.mark.parametrize(
    "changes",
    [
        {"bins": ()},
        {"bins": (), "low": (-1.0, -1.0), "high": (1.0, 1.0)},
        {"sampled": (False, False)},
        {"sampled": (True, True)},
        {"bins": (2, 9), "sampled": (True, True)},
        {"octaves": (0, 0, 0)},
        {"octaves": (0, 0, 0), "cost_range": None},
        {"cost_range": None},
        {"acquisition": "random"},
        {"acquisition": "random", "cost_range": None},
        {"acquisition": "all"},
        {"acquisition": "none"},
    ],
    ids=str,
)
@pytest.mark.parametrize("method", ["bdt", "rcbc", "bc"])
def test_every_head_and_every_input(method: str, changes: dict[str, object]) -> None:
    changes = {"context_length": 4 if method == "bdt" else 1, "method": method, **changes}
    model = variant(5, **changes)
    normalise(model)
    assert reads_noise(model) == (bool(model.config.bins) and any(model.config.sampled))
    assert largest_difference(model, 5) <= 1e-4


@pytest.mark.parametrize("method", ["bdt", "rcbc"])
def test_numbers_far_from_zero_keep_their_digits(method: str) -> None:
    """A mean of four thousand scales, as a number that hardly ever changed has: folded into the weights it would leave
    three digits."""
    model = variant(6, method=method, context_length=4 if method == "bdt" else 1)
    normalise(model, far=True)
    assert largest_difference(model, 6, far=True) <= 1e-4


def test_the_noise_picks_the_bin_that_torch_picks_up_to_its_last_step() -> None:
    """Nothing is beyond the last bin, however the probabilities' sum is rounded."""
    model = variant(7, bins=(5, 2), sampled=(True, True), method="rcbc", context_length=1)
    graph = action_graph(model)
    n = 400
    random = np.random.default_rng(0)
    feed = {
        "prepared": random.normal(size=(n, model.config.encoder_width)).astype(np.float32),
        "acquired": np.zeros((n, len(OWNER) + model.config.n_queries), dtype=np.float32),
        "noise": np.full((n, 2), 1.0 - 2.0**-24, dtype=np.float32),
    }
    (action,) = session(graph).run(["action"], feed)
    assert (action == [1.0, 1.0]).all()


def test_few_nodes_and_no_input_that_is_not_read() -> None:
    """What they are for: a node costs about a microsecond, whatever it does."""
    model = network(0)
    before, now = (onnx.load_from_string(graph(model).content()).graph for graph in (acquisition_graph, action_graph))
    assert len(before.node) <= 13
    assert len(now.node) <= 11 + 22 * model.config.n_layers + 10  # ten for the component that is sampled
    shared = onnx.load_from_string(action_graph(network(0, n_kv_heads=1)).content()).graph
    assert len(shared.node) <= 11 + 18 * model.config.n_layers + 10
    for graph in (before, now):
        read = {name for node in graph.node for name in node.input}
        assert {port.name for port in graph.input} <= read
    assert "noise" not in action_graph(variant(0, sampled=(False, False))).inputs
