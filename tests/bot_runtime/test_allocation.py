"""What a frame of bots that are named again and again takes from the heap: the reply, and little on the way to it."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from bot_runtime.bots import Bots
from bot_runtime.bundle import Bundle
from bot_runtime.turns import Actions, Queries
from tests.bundles import make_bundle

WARM_UP, FRAMES = 60, 64  # a few bots' noise is drawn sixteen turns ahead


@pytest.fixture(scope="module")
def long_bundle(tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    """One whose context is large beside everything else."""
    return Bundle.load(make_bundle(tmp_path_factory.mktemp("bundles") / "long", context_length=33, budget=1.0))


@pytest.fixture
def tracing() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


def frames(bundle: Bundle, n_bots: int) -> Iterator[tuple[Queries, Actions]]:
    """The same content again and again, so that nothing but the bots allocates."""
    bots, table = Bots(bundle, max_bots=n_bots), bundle.manifest.features
    handles = bots.start(n_bots)
    free, costly = (np.zeros((n_bots, size), dtype=np.float32) for size in (table.n_free, table.n_costly))
    for frame in range(WARM_UP + FRAMES):
        queries = bots.request_queries(handles, frame, free)
        yield queries, bots.submit_features(handles, frame, queries.query_NM, costly)


@pytest.mark.parametrize("n_bots", [1, 8, 64])
@pytest.mark.usefixtures("tracing")
def test_a_steady_frame_takes_its_reply_and_noise_and_gives_back_the_last(long_bundle: Bundle, n_bots: int) -> None:
    manifest = long_bundle.manifest
    context_bytes = 8 * n_bots * manifest.n_layers * manifest.n_slots * math.prod(manifest.token)
    noise_bytes = 32 * max(n_bots, 16) * (manifest.features.n_queries + manifest.action.size)
    traced = np.zeros((WARM_UP + FRAMES, 2), dtype=np.int64)  # held after each frame, and at most in it
    last: tuple[Queries, Actions] | tuple[()] = ()
    for frame, reply in enumerate(frames(long_bundle, n_bots)):
        traced[frame] = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        last = reply
    reply_bytes = sum(part.nbytes for half in last for part in half if isinstance(part, np.ndarray))
    held, peak = traced[WARM_UP:].T
    assert held.max() - held.min() <= 2048
    limit = 2 * reply_bytes + noise_bytes + 4096
    assert (peak[1:] - held[:-1]).max() <= limit
    assert n_bots == 1 or limit < context_bytes  # a copy of the context would be seen
