"""Which frames are worth more in training: those whose action a network that acquires nothing gets wrong.

A recorded path tells what its player knew: who turned is seen to turn, and goes on turning. A network that is taught
all frames alike predicts most of them from that, and asks little; at play its own path tells it nothing. What has to be
known shows in the frames that neither the free features nor the past explain. Weighting those is Wen et al.,
*Keyframe-Focused Visual Imitation Learning*, ICML 2021 (weights by the loss of a "copycat"); the copycat here is a run
with `acquisition: none`. This module knows nothing about optimisers.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from rich.progress import track
from torch import Tensor

from training.checkpoint import Trained, load_trained
from training.traces import Traces

__all__ = ["weigh_keyframes"]

_LEAST = 0.3  # weight of a frame that is predicted surely
_MOST = 4.0  # the rest grows with the loss, in multiples of its mean, up to here: a kicked player is not a lesson


def weigh_keyframes(run: Path, traces: Traces) -> Traces:
    """The same traces with a weight for each timestep, 1 in the mean. Raises ValueError for a run of other features, or
    one that acquires anything, or whose actions have no bins (their loss is no measure of surprise)."""
    blind = load_trained(run / "checkpoint.pt")
    if blind.facts.features != traces.layout.features or blind.facts.action != traces.layout.action:
        raise ValueError(f"{run} was trained on other features or actions than these traces have")
    if blind.config.acquisition != "none" or not blind.config.bins:
        asked, bins = blind.config.acquisition, blind.config.bins
        raise ValueError(f"{run} has acquisition {asked} and bins {bins}, expected none, and actions with bins")
    losses_S = torch.ones_like(traces.returns_to_go_S)
    for i in track(range(len(traces)), description=f"weighing frames by {run.name}"):
        first = int(traces.starts_E[i])
        losses_S[first : first + int(traces.lengths_E[i])] = _losses(blind, traces, i)
    seen = torch.zeros_like(losses_S, dtype=torch.bool)
    for first, length in zip(traces.starts_E.tolist(), traces.lengths_E.tolist(), strict=True):
        seen[first : first + length] = True
    raised_S = (losses_S / losses_S[seen].mean()).clamp(max=_MOST)
    weights_S = _LEAST + (1.0 - _LEAST) * raised_S
    return replace(traces, weights_S=weights_S / weights_S[seen].mean())


@torch.no_grad()
def _losses(blind: Trained, traces: Traces, episode: int) -> Tensor:
    """-log π̃ of each recorded action of an episode, [T]."""
    steps, model = traces.episode(episode), blind.model
    togo_1T1 = steps.returns_to_go_T[None, :, None]
    known = model.know(steps.free_TF[None], togo_1T1, torch.zeros_like(togo_1T1), steps.costly_TD[None].float())
    nothing = torch.zeros(1, len(steps.free_TF), model.config.n_queries)
    return model.action_head.losses(model.hiddens(known, nothing), steps.actions_TA[None])[0]
