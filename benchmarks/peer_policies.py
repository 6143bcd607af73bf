"""The same step in public Decision Transformers: Hugging Face `transformers` and d3rlpy, as fast as their APIs allow.

Both have a bundle's layers, heads, width and context and random weights; an observation is as many numbers as our
graphs read (free, costly, query). They are in eval mode under `torch.inference_mode`, and recompute their window at
every step, as their documentation does. This module knows nothing about time or transports. It needs the extra `peers`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from d3rlpy.algos import DecisionTransformerConfig as D3rlpyConfig
from d3rlpy.algos import IdentityTransformerActionSampler
from d3rlpy.models import VectorEncoderFactory
from numpy.typing import NDArray
from transformers import DecisionTransformerConfig as HuggingFaceConfig
from transformers import DecisionTransformerModel

from bot_runtime.manifest import Manifest

__all__ = ["Attention", "D3rlpy", "HuggingFace", "observation_width"]

Attention = Literal["sdpa", "eager"]

_TARGET_RETURN = 100.0
_MAX_STEPS = 4096  # that either has an embedding for; later ones are the last
_WINDOWS = 32  # how many windows' worth of steps the history holds before it is moved to its beginning


def observation_width(manifest: Manifest) -> int:
    """How many numbers a bot's state has: what our graphs read of it."""
    table = manifest.features
    return table.n_free + table.n_costly + table.n_queries


class HuggingFace:
    """`DecisionTransformerModel` over the last K steps of N bots, all in one batch.

    The window is a view of a history that grows in place, so that a step copies nothing that the model does not. It is
    always full: a shorter one at an episode's beginning would only be faster for its K steps.
    """

    def __init__(self, manifest: Manifest, n_bots: int, attention: Attention = "sdpa") -> None:
        torch.set_num_threads(1)
        torch.manual_seed(0)
        self._length, n_action = manifest.context_length, len(manifest.action.components)
        config = HuggingFaceConfig(
            state_dim=observation_width(manifest),
            act_dim=n_action,
            hidden_size=manifest.width,
            n_layer=manifest.n_layers,
            n_head=manifest.n_heads,
            max_ep_len=_MAX_STEPS,
            use_cache=False,  # it would be filled and thrown away at every step
            bos_token_id=None,
            eos_token_id=None,
        )
        self.model = DecisionTransformerModel(config).eval()
        self.model.set_attn_implementation(attention)
        size = _WINDOWS * self._length
        self._states = torch.zeros(n_bots, size, config.state_dim)
        self._actions = torch.zeros(n_bots, size, n_action)
        self._rewards = torch.zeros(n_bots, size, 1)
        self._returns = torch.full((n_bots, size, 1), _TARGET_RETURN)
        self._timesteps = torch.zeros(n_bots, size, dtype=torch.long)
        self._mask = torch.ones(n_bots, self._length)
        self._at, self._step = self._length - 1, 0

    def act(self, observation_NO: NDArray[np.float32], reward: float) -> NDArray[np.float32]:
        """The actions [N, A] for the bots' next observations and the reward of each since the last."""
        if self._at == self._states.shape[1]:
            self._move_to_beginning()
        at, begin = self._at, self._at - self._length + 1
        self._states[:, at] = torch.from_numpy(observation_NO)
        self._rewards[:, at] = reward
        self._returns[:, at] = self._returns[:, at - 1] - reward
        self._timesteps[:, at] = min(self._step, _MAX_STEPS - 1)
        self._actions[:, at] = 0.0  # what is asked for, as in the documentation's example
        with torch.inference_mode():
            _, actions, _ = self.model(
                states=self._states[:, begin : at + 1],
                actions=self._actions[:, begin : at + 1],
                rewards=self._rewards[:, begin : at + 1],
                returns_to_go=self._returns[:, begin : at + 1],
                timesteps=self._timesteps[:, begin : at + 1],
                attention_mask=self._mask,
                return_dict=False,
            )
        self._actions[:, at] = actions[:, -1]
        self._at, self._step = at + 1, self._step + 1
        return self._actions[:, at].numpy()

    def _move_to_beginning(self) -> None:
        kept = self._length - 1
        for history in (self._states, self._actions, self._rewards, self._returns, self._timesteps):
            history[:, :kept] = history[:, -kept:].clone()
        self._at = kept


class D3rlpy:
    """d3rlpy's DecisionTransformer through its own stateful wrapper: one bot a call, all that its API allows."""

    def __init__(self, manifest: Manifest, n_bots: int) -> None:
        torch.set_num_threads(1)
        torch.manual_seed(0)
        config = D3rlpyConfig(
            context_size=manifest.context_length,
            max_timestep=_MAX_STEPS,
            num_heads=manifest.n_heads,
            num_layers=manifest.n_layers,
            # One linear layer, as Hugging Face embeds a state; d3rlpy's own default is two of 256.
            encoder_factory=VectorEncoderFactory([manifest.width], exclude_last_activation=True),
        )
        algorithm = config.create(device="cpu:0")
        algorithm.create_impl((observation_width(manifest),), len(manifest.action.components))
        sampler = IdentityTransformerActionSampler()
        self._bots = [algorithm.as_stateful_wrapper(_TARGET_RETURN, sampler) for _ in range(n_bots)]

    def act(self, observation_NO: NDArray[np.float32], reward: float) -> NDArray[np.float32]:
        """The actions [N, A] for the bots' next observations and the reward of each since the last."""
        with torch.inference_mode():
            pairs = zip(self._bots, observation_NO, strict=True)
            return np.stack([bot.predict(observation_O, reward) for bot, observation_O in pairs])
