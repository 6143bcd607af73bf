"""What chance gives an update: windows, the target cost of each, and the noise of its queries.

This module knows nothing about networks. Shape letters as in `training.traces`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from training import workers
from training.config import TrainConfig
from training.control import draw_costs
from training.traces import Batch, Traces, choose_windows, read_windows

__all__ = ["Drawn", "Whole", "draw", "draw_share"]


class Whole(NamedTuple):
    """What every worker knows of a batch that they share."""

    target_B: Tensor  # C of each window
    stratum_B: Tensor  # and which γ it has
    counted_BT: Tensor
    last_BT: Tensor


@dataclass(frozen=True)
class Drawn:
    """A worker's part of a batch, and what chance gave it."""

    batch: Batch
    target_B: Tensor
    stratum_B: Tensor
    uniforms_BTM: Tensor
    counted_BT: Tensor  # 1 at the timesteps that teach: not padding, nor burnt in
    whole: Whole


def draw(config: TrainConfig, traces: Traces, chance: np.random.Generator, rows: slice = slice(None)) -> Drawn:
    """A batch is drawn whole; `rows` of it are read."""
    windows = choose_windows(traces, config.batch, config.window, chance, config.beginnings)
    shape = (config.batch, config.window, traces.layout.features.n_queries)
    uniforms = torch.from_numpy(chance.random(shape, dtype=np.float32)[rows]).to(config.device)
    batch = read_windows(traces, windows.rows(rows))
    # Past an episode's end nothing is asked for, so that padding takes nothing of a budget that windows share.
    uniforms = torch.where(batch.valid_BT[..., None] > 0.0, uniforms, 1.0)
    together = _together(config)
    targets, strata = np.full(config.batch, config.budget, np.float32), np.zeros(config.batch, np.int64)
    if config.budgets:
        drawn = draw_costs(config.budgets, config.batch // together, chance)
        targets, strata = (part.repeat(together) for part in drawn)
    known = (torch.from_numpy(targets), torch.from_numpy(strata), windows.counted_BT(config.burn_in), windows.last_BT)
    whole = Whole(*(part.to(config.device) for part in known))
    return Drawn(batch, whole.target_B[rows], whole.stratum_B[rows], uniforms, whole.counted_BT[rows], whole)


def draw_share(config: TrainConfig, traces: Traces, chance: np.random.Generator) -> Drawn:
    """This worker's part of a batch. Raises ValueError where the batch cannot be shared out."""
    return draw(config, traces, chance, workers.share(config.batch, _together(config)))


def _together(config: TrainConfig) -> int:
    """Windows that share a budget, and so belong to one worker."""
    return config.frame_bots if config.allocation == "frame" else 1
