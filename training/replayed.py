"""What a bundle does over the free numbers, rewards and costly numbers of a golden episode, turn by turn.

This module knows nothing about files, torch or how a bundle was made.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bot_runtime.bundle import Bundle
from bot_runtime.context import Contexts
from bot_runtime.golden import Golden
from bot_runtime.policy import Policy, action_arrays

__all__ = ["Replayed", "replayed"]

_ONE_BOT = np.array([0], dtype=np.int64)


@dataclass(frozen=True)
class Replayed:
    """T turns: what the action graph was given, by input, rows are turns; what both graphs answered; the noise."""

    given: dict[str, NDArray[np.generic]]
    probs_TM: NDArray[np.float32]
    queries_TM: NDArray[np.bool_]
    actions_TA: NDArray[np.float32]
    hidden_TW: NDArray[np.float32]
    noise_TM: NDArray[np.float32]


def replayed(bundle: Bundle, golden: Golden, queries_TM: NDArray[np.bool_] | None = None) -> Replayed:
    """Play the episode with these queries, or (None) with those that the bundle samples itself by its golden noise."""
    manifest, policy = bundle.manifest, Policy(bundle)
    table, contexts = manifest.features, Contexts(manifest, 1)
    contexts.begin(_ONE_BOT, golden["seed"].astype(np.uint64).reshape(1), np.zeros(1))
    batch = contexts.batch(_ONE_BOT)
    batch.target_cost_N1[:] = golden.get("target_cost", 0.0)
    returns_to_go_T = golden["target_return"].astype(np.float64) - np.cumsum(golden["rewards"].astype(np.float64))
    given: list[dict[str, NDArray[np.generic]]] = []
    rows: list[tuple[NDArray[np.generic], ...]] = []
    for turn in range(len(golden["free"])):
        batch.free_NF[:], batch.left_N1[:] = golden["free"][turn], returns_to_go_T[turn]
        policy.query_probs(batch)
        batch.keep_prepared()
        noise_N, probs_M = contexts.noise(batch), batch.probs_NM[0].copy()
        query_M = noise_N[0, : table.n_queries] < probs_M if queries_TM is None else queries_TM[turn]
        batch.query_NM[:] = query_M
        batch.costly_ND[:] = np.where(query_M[table.owner], golden["costly"][turn], 0.0)
        if manifest.samples_action:
            batch.noise_NA[:] = noise_N[:, table.n_queries :]
        given.append({name: array.copy() for name, array in action_arrays(manifest, batch)[0].items()})
        policy.act(batch)
        rows.append((probs_M, query_M, batch.action_NA[0].copy(), batch.hidden_NW[0].copy(), noise_N[0]))
        contexts.advance(batch, batch.action_NA)
    probs, queries, actions, hidden, noise = (np.stack(column) for column in zip(*rows, strict=True))
    inputs = {name: np.concatenate([turn[name] for turn in given]) for name in given[0]}
    return Replayed(inputs, probs, queries, actions, hidden, noise[:, : table.n_queries])
