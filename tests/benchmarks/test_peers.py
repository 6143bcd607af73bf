"""The benchmark of peers: what a ratio is, the policy server, and, where they are, the peers themselves."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks import peers
from benchmarks.peers import Peers, Row, as_line, fastest, main, measure
from benchmarks.policy_server import PolicyClient, pack, policy_server, unpack
from benchmarks.recorded import RecordedFrames
from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.golden import read_golden
from tests.bundles import make_bundle

needs_peers = pytest.mark.skipif(bool(peers.missing()), reason=f"the extra `peers` is not here: {peers.missing()}")


def row(name: str, *us: float, n_bots: int = 1) -> Row:
    return Row(name, n_bots, np.array(us))


def test_a_ratio_is_the_median_of_rounds_so_that_a_machine_that_drifts_changes_nothing() -> None:
    ours, peer = row("ours", 1.0, 2.0, 9.0, 4.0, 1.0), row("peer", 10.0, 20.0, 90.0, 40.0, 5.0)
    assert peer.ratio(ours) == 10.0


def test_the_fastest_peer_is_one_in_process_at_as_many_bots() -> None:
    ours = row("ours", 1.0)
    others = [row("ours, int8", 0.5), row("policy server, our bots", 2.0), row("fast", 3.0, n_bots=64)]
    assert fastest([ours, *others, row("slow", 9.0), row("quick", 5.0)], ours).name == "quick"


def test_the_line_has_a_ratio_for_each_number_of_bots_and_null_without_an_int8_bundle() -> None:
    rows = [row("ours", 2.0), row("peer", 50.0), row("ours", 1.0, n_bots=64), row("peer", 80.0, n_bots=64)]
    line = as_line(rows)
    assert (line["ratio_1"], line["ratio_64"], line["ratio_64_int8"]) == (25.0, 80.0, None)
    assert as_line([*rows, row("ours, int8", 0.5, n_bots=64)])["ratio_64_int8"] == 160.0


def test_what_is_missing_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(peers, "_NEEDED", ("numpy", "no_such_package"))
    assert main(Peers()) == 2
    said = capsys.readouterr().err
    assert "no_such_package" in said
    assert "make bench-peers" in said


def test_arrays_pass_through_the_policy_servers_packing() -> None:
    sent = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array([[True]]), "c": 1.5, "d": {"e": [1, "f"]}}
    got = unpack(pack(sent))
    assert got["a"].dtype == np.float32
    assert np.array_equal(got["a"], sent["a"])
    assert np.array_equal(got["b"], sent["b"])
    assert (got["c"], got["d"]) == (1.5, {"e": [1, "f"]})


def test_our_bots_act_the_same_behind_the_policy_server(tmp_path: Path) -> None:
    path, n_bots = make_bundle(tmp_path / "tiny"), 3
    bundle = Bundle.load(path)
    bots = Bots(bundle, max_bots=n_bots)
    handles = bots.start(n_bots)
    golden = read_golden((path / "golden.npz").read_bytes(), bundle.manifest)
    frames = RecordedFrames(bundle.manifest.features, golden, n_bots)
    with policy_server("bots", path) as serving, PolicyClient(serving.port) as client:
        assert client.metadata == {"policy": "bots"}
        for frame in range(6):
            query_NM = client.infer({"frame": frame, "free": frames.free(frame)})["query"]
            assert np.array_equal(query_NM, bots.request_queries(handles, frame, frames.free(frame)).query_NM)
            known_ND = frames.known(frame, query_NM)
            reply = client.infer({"frame": frame, "query": query_NM, "costly": known_ND})
            assert np.array_equal(reply["action"], bots.submit_features(handles, frame, query_NM, known_ND).action_NA)
            assert reply["server_timing"]["infer_ms"] > 0.0


@needs_peers
@pytest.mark.filterwarnings("ignore")  # of gym and others, as they are imported
def test_every_row_is_timed_and_printed_in_one_line(tmp_path: Path) -> None:
    path = make_bundle(tmp_path / "tiny")
    config = Peers(path, tmp_path / "none", bots=(1, 2), rounds=2, slice_s=0.001, pin=False)
    rows = measure(config, Console(quiet=True))
    assert len({row.name for row in rows}) == 9
    assert all(row.us_R.shape == (2,) and (row.us_R > 0).all() for row in rows)
    command = [sys.executable, "-m", "benchmarks.peers", "--bundle", str(path), "--int8", str(path), "--clock", "cpu"]
    command += ["--bots", "1", "2", "--rounds", "2", "--slice-s", "0.001", "--json"]
    (printed,) = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    line = json.loads(printed)
    assert set(line["us_2"]) == {"ours", "ours, int8", "transformers", "transformers, eager", "d3rlpy, one by one"}
    assert min(line["ratio_1"], line["ratio_2"], line["ratio_2_int8"]) > 0


@needs_peers
@pytest.mark.filterwarnings("ignore")  # of gym and others, as they are imported
def test_hugging_faces_window_slides_over_its_history() -> None:
    """Against the same model on a window cut out of the whole history, well beyond where the history starts over."""
    import torch

    from benchmarks.peer_policies import HuggingFace, observation_width

    manifest = Bundle.load(Path("bundles/hard")).manifest
    peer, random = HuggingFace(manifest, 2), np.random.default_rng(0)
    length, width = manifest.context_length, observation_width(manifest)
    states = np.zeros((2, length - 1, width), dtype=np.float32)
    actions, returns = np.zeros((2, length - 1, 3), dtype=np.float32), np.full((2, length - 1, 1), 100.0)
    steps = [0] * (length - 1)
    for step in range(40 * length):
        observed = random.standard_normal((2, width)).astype(np.float32)
        states = np.concatenate([states, observed[:, None]], axis=1)[:, -length:]
        actions = np.concatenate([actions, np.zeros((2, 1, 3), dtype=np.float32)], axis=1)[:, -length:]
        returns = np.concatenate([returns, returns[:, -1:] - 0.5], axis=1)[:, -length:]
        steps = [*steps, step][-length:]
        acted = peer.act(observed, 0.5)
        if step % 97 == 0 or step > 40 * length - 3:
            with torch.inference_mode():
                expected = peer.model(
                    states=torch.from_numpy(states),
                    actions=torch.from_numpy(actions),
                    rewards=torch.full((2, length, 1), 0.5),
                    returns_to_go=torch.from_numpy(returns.astype(np.float32)),
                    timesteps=torch.tensor([steps, steps]),
                    attention_mask=torch.ones(2, length),
                    return_dict=False,
                )[1][:, -1]
            assert np.allclose(acted, expected.numpy(), atol=1e-5)
        actions[:, -1] = acted
