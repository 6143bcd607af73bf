"""The short form of 1,000 exchanges under load."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console

from benchmarks.swaps import Expected, Swaps, measure
from benchmarks.variants import write_variant
from bot_runtime.bundle import Bundle
from tests.bundles import make_bundle


def test_no_frame_fails_and_no_episode_is_of_two_versions(tmp_path: Path) -> None:
    config = Swaps(make_bundle(tmp_path / "tiny"), swaps=12, bots=2, frames=8, quiet_s=0.0)
    found = measure(config, Console(quiet=True))
    assert (found["swaps"], found["failed_frames"], found["mixed_episodes"]) == (12, 0, 0), found
    assert found["frames"] >= 8 * found["episodes"] > 0


def test_an_episode_of_two_versions_would_be_seen(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    for version in (1, 2, 3):
        write_variant(bundle, tmp_path / "store" / str(version), name="other", seed=version - 1)
    expected = Expected(tmp_path / "store", Swaps(bundle, bots=2, frames=8))
    assert expected.telling == 1.0
    own, other = expected.turns[1], expected.turns[2]
    assert expected.is_of(1, own)
    assert not any(expected.is_of(version, [*own[:i], *other[i:]]) for i in range(1, 8) for version in (1, 2, 3))


def test_a_variant_is_another_bundle_that_verifies(tmp_path: Path) -> None:
    bundle = make_bundle(tmp_path / "tiny")
    one = Bundle.load(write_variant(bundle, tmp_path / "one", name="other", seed=0))
    two = Bundle.load(write_variant(bundle, tmp_path / "two", name="other", seed=1))
    assert one.name == two.name == "other"
    assert one.manifest.features == two.manifest.features
    assert one.sha256 != two.sha256
    with np.load(tmp_path / "one" / "golden.npz") as left, np.load(bundle / "golden.npz") as right:
        assert all(np.allclose(left[name], right[name], atol=1e-5) for name in right.files)
