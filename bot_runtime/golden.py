"""The golden replay: a recorded episode goes through the graphs again and must come out the same.

This module knows nothing about directories, hashes or bots that play.
"""

from __future__ import annotations

import io
import zipfile
import zlib

import numpy as np
from numpy.typing import NDArray

from bot_runtime.context import Contexts
from bot_runtime.manifest import Manifest
from bot_runtime.policy import Policy
from protocol.errors import BadBundle

__all__ = ["MAX_UNPACKED_BYTES", "Golden", "read_golden", "replay"]

MAX_UNPACKED_BYTES = 64 * 2**20
Golden = dict[str, NDArray[np.generic]]
# What zipfile, zlib and numpy raise for hostile bytes; MemoryError is a header that claims a vast array.
_UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    MemoryError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
_ONE_BOT = np.array([0], dtype=np.int64)


def read_golden(content: bytes, manifest: Manifest) -> Golden:
    """The arrays of golden.npz, shapes and finiteness checked.

    T turns, more than the context length: `free` [T, F], `costly` [T, D] (every value), `rewards` [T], `probs` [T, M],
    `queries` [T, M] of 0 and 1, `actions` [T, A], with a context `hidden` [T, W], and the scalars `seed`,
    `target_return` and, where the network is conditioned on it, `target_cost`. Raises BadBundle.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > MAX_UNPACKED_BYTES:
            raise BadBundle(f"golden.npz unpacks to {unpacked} bytes, expected at most {MAX_UNPACKED_BYTES}")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays: Golden = {name: archive[name] for name in archive.files}
    except _UNREADABLE as error:
        raise BadBundle(f"golden.npz is not an archive of plain arrays: {error}") from error
    _check_shapes(arrays, manifest)
    return arrays


def replay(policy: Policy, manifest: Manifest, golden: Golden) -> None:
    """Run the recorded episode. Raises BadBundle when probs, actions or hidden differ by more than the tolerance.

    The queries come from the record: a probability that moves by one rounding may sit on the other side of its noise.
    """
    contexts = Contexts(manifest, 1)
    contexts.begin(_ONE_BOT, golden["seed"].astype(np.uint64).reshape(1), np.zeros(1))
    batch = contexts.batch(_ONE_BOT)
    returns_to_go_T = golden["target_return"].astype(np.float64) - np.cumsum(golden["rewards"].astype(np.float64))
    query_TM, n_queries = golden["queries"].astype(np.bool_), manifest.features.n_queries
    costly_TD = np.where(query_TM[:, manifest.features.owner], golden["costly"], 0.0)
    batch.target_cost_N1[:] = golden.get("target_cost", 0.0)
    for turn in range(len(query_TM)):
        batch.free_NF[:], batch.left_N1[:] = golden["free"][turn], returns_to_go_T[turn]
        policy.query_probs(batch)
        _compare("probs", turn, batch.probs_NM[0], golden["probs"][turn], manifest.tolerance)
        batch.keep_prepared()
        batch.costly_ND[:], batch.query_NM[:] = costly_TD[turn], query_TM[turn]
        if manifest.samples_action:
            batch.noise_NA[:] = contexts.noise(batch)[:, n_queries:]
        policy.act(batch)
        _compare("actions", turn, batch.action_NA[0], golden["actions"][turn], manifest.tolerance)
        if manifest.has_context:
            _compare("hidden", turn, batch.hidden_NW[0], golden["hidden"][turn], manifest.tolerance)
        contexts.advance(batch, batch.action_NA)


def _compare(name: str, turn: int, got: NDArray[np.generic], recorded: NDArray[np.generic], tolerance: float) -> None:
    difference = float(np.max(np.abs(np.subtract(got, recorded, dtype=np.float64)), initial=0.0))
    if not difference <= tolerance:  # NaN is a difference too
        raise BadBundle(
            f"golden replay: {name} of turn {turn} differ by {difference:g}, expected at most {tolerance:g}"
        )


def _check_shapes(arrays: Golden, manifest: Manifest) -> None:
    table, turns = manifest.features, len(arrays["free"]) if arrays.get("free", np.array(0)).ndim == 2 else 0
    expected: dict[str, tuple[int, ...]] = {
        "seed": (),
        "target_return": (),
        "free": (turns, table.n_free),
        "costly": (turns, table.n_costly),
        "rewards": (turns,),
        "probs": (turns, table.n_queries),
        "queries": (turns, table.n_queries),
        "actions": (turns, manifest.action.size),
    }
    if manifest.has_context:
        expected["hidden"] = (turns, manifest.width)
    if manifest.is_conditioned:
        expected["target_cost"] = ()
    if set(arrays) != set(expected):
        raise BadBundle(f"golden.npz holds {sorted(arrays)}, expected {sorted(expected)}")
    if turns <= manifest.context_length:
        raise BadBundle(f"golden.npz has {turns} turns, expected more than the context's {manifest.context_length}")
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise BadBundle(f"golden.npz {name} has shape {list(arrays[name].shape)}, expected {list(shape)}")
        if arrays[name].dtype.kind not in "fui" or not np.isfinite(arrays[name]).all():
            raise BadBundle(f"golden.npz {name} is {arrays[name].dtype}, expected finite real numbers")
    if not np.isin(arrays["queries"], (0, 1)).all():
        raise BadBundle("golden.npz queries hold other numbers than 0 and 1")
