"""The noise is SplitMix64, uniform, and the same for a bot in any batch."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bot_runtime.noise import mix, uniforms

MASK = 2**64 - 1
SEEDS = st.integers(0, MASK)


def mix_in_python(z: int) -> int:
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & MASK
    z = (z ^ z >> 27) * 0x94D049BB133111EB & MASK
    return z ^ z >> 31


def test_mix_is_splitmix64() -> None:
    """The reference generator's first outputs from state 0 (its state advances by the golden gamma)."""
    gamma = 0x9E3779B97F4A7C15
    states = np.array([gamma * i & MASK for i in (1, 2, 3)], dtype=np.uint64)
    assert [hex(out) for out in mix(states).tolist()] == [
        "0xe220a8397b1dcdaf",
        "0x6e789e6aa1b965f4",
        "0x6c45d188009454f",
    ]


@given(SEEDS, st.integers(0, 2**40), st.integers(0, 50))
def test_equals_integers_of_python(seed: int, turn: int, index: int) -> None:
    gamma = 0x9E3779B97F4A7C15
    row = mix_in_python(mix_in_python(seed + gamma & MASK) + turn * gamma & MASK)
    expected = (mix_in_python(row + (index + 1) * gamma & MASK) >> 40) / 2**24
    got = uniforms(np.array([seed], dtype=np.uint64), np.array([turn]), index + 1)
    assert got.dtype == np.float32
    assert float(got[0, index]) == expected


@given(st.lists(st.tuples(SEEDS, st.integers(0, 10**6)), min_size=1, max_size=5), st.integers(1, 8))
def test_a_row_depends_on_its_own_bot_only_and_prefixes_agree(bots: list[tuple[int, int]], count: int) -> None:
    seeds, turns = np.array([b[0] for b in bots], dtype=np.uint64), np.array([b[1] for b in bots])
    together = uniforms(seeds, turns, count)
    for row in range(len(bots)):
        alone = uniforms(seeds[row : row + 1], turns[row : row + 1], count + 3)
        assert alone[0, :count].tobytes() == together[row].tobytes()


def test_uniform_on_the_unit_interval() -> None:
    """One million numbers: each of 64 bins within 5 standard deviations, lag correlations within 5."""
    noise = uniforms(np.arange(100, dtype=np.uint64), np.arange(100), 10_000)
    assert noise.min() >= 0.0
    assert noise.max() < 1.0
    counts, _ = np.histogram(noise, bins=64, range=(0.0, 1.0))
    expected = noise.size / 64
    assert np.abs(counts - expected).max() < 5.0 * np.sqrt(expected)
    centred = (noise - 0.5).astype(np.float64) * np.sqrt(12.0)
    for shifted in (centred[:, 1:] * centred[:, :-1], centred[1:] * centred[:-1]):
        assert abs(shifted.mean()) < 5.0 / np.sqrt(shifted.size)
