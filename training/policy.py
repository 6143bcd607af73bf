"""What every budgeted policy shares: its inputs, its acquisition head π̂ and its action head π̃.

A subclass says what it remembers (`memory`, what π̂ reads of the past) and how a frame becomes the state that π̃ reads
(`hiddens`). This module knows nothing about losses, sampling or files. Shape letters: B batch, T time, W width of the
state, E encoder width, C numbers known before the query; F free numbers, M costly features, D costly numbers, A action
components; `...` any leading axes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from training.action_heads import ActionHead, BinsHead, GaussianHead

__all__ = ["COST_OCTAVES", "BudgetedPolicy", "Known", "ModelConfig"]

COST_OCTAVES = 3  # sine/cosine octaves of the target cost


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of one network."""

    octaves: tuple[int, ...]  # sine/cosine octaves of each of the F free numbers: positions must be told apart finely
    owner: tuple[int, ...]  # costly feature that each of the D costly numbers belongs to
    n_queries: int  # M
    bins: tuple[int, ...]  # bins of each action component, A of them; none: each is a number with a certainty
    low: tuple[float, ...]  # lowest value of each action component
    high: tuple[float, ...]  # highest value of each action component
    sampled: tuple[bool, ...]  # True: the component is sampled from its bins, False: the most probable bin is taken
    method: str = "bdt"  # bdt | rcbc | bc | iql
    context_length: int = 20  # K, the attention span in timesteps; 1: no memory
    width: int = 64  # W
    n_layers: int = 2  # L
    n_heads: int = 4  # H
    n_kv_heads: int | None = None  # G, heads of keys and values; None: H
    encoder_width: int = 128  # E, hidden width of the token encoder and of the acquisition head
    acquisition: str = "learned"  # learned | random | all | none: whether queries are learned, drawn, or forced
    acquisition_bias: float = 0.0  # initial logit of every query probability
    target_cost: float = 1.0  # C, where it is no input
    cost_range: tuple[float, float] | None = None  # where C is an input of the acquisition head: what it was drawn from

    @property
    def budget_conditioned(self) -> bool:
        """Whether C is an input of the acquisition head."""
        return self.cost_range is not None

    @property
    def n_free(self) -> int:
        """F."""
        return len(self.octaves)

    @property
    def n_actions(self) -> int:
        """A."""
        return len(self.low)

    @property
    def token(self) -> tuple[int, int]:
        """(G, h): heads of a key, and of a value, and numbers of each."""
        return self.n_kv_heads or self.n_heads, self.width // self.n_heads

    @property
    def has_memory(self) -> bool:
        """Whether a frame's outcome depends on the frames before it."""
        return self.method == "bdt"

    @property
    def reads_returns(self) -> bool:
        """Whether the return-to-go is an input: behavioural cloning and IQL have none."""
        return self.method in ("bdt", "rcbc")


class Normalisation(nn.Module):
    """(x - mean) / scale per number; lives inside the network so that an engine sends raw numbers."""

    mean: Tensor
    scale: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    def fit(self, mean: Tensor, scale: Tensor) -> None:
        """Take the statistics of the traces, each shape [size]; scales must be positive."""
        self.mean.copy_(mean)
        self.scale.copy_(scale)

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.scale


class AcquisitionHead(nn.Module):
    """Logits of the query from what is remembered and what is known before it. One hidden layer, whose two inputs have
    weights of their own: what does not depend on the query is computed for a whole window at once."""

    def __init__(self, memory: int, context: int, config: ModelConfig) -> None:
        super().__init__()
        self.from_memory = nn.Linear(memory, config.encoder_width, bias=False) if memory else None
        self.from_context = nn.Linear(context, config.encoder_width)
        self.out = nn.Linear(config.encoder_width, config.n_queries)
        nn.init.zeros_(self.out.weight)
        nn.init.constant_(self.out.bias, config.acquisition_bias)

    def forward(self, memory: Tensor, prepared: Tensor) -> Tensor:
        """`prepared` [..., E] is `from_context` of what is known before the query."""
        if self.from_memory is not None:
            prepared = prepared + self.from_memory(memory)
        return self.out(torch.relu(prepared))


@dataclass(frozen=True)
class Known:
    """What does not depend on the query, computed once for a window."""

    acquisition: Tensor  # [..., E], into the acquisition head
    token: Tensor  # [..., E], into the encoder
    costly: Tensor  # [..., D], normalised
    target_cost: Tensor  # C, [..., 1]

    def at(self, t: int) -> Known:
        """Timestep `t` of [B, T, ...]."""
        return Known(self.acquisition[:, t], self.token[:, t], self.costly[:, t], self.target_cost[:, t])

    def rows(self, index_B: Tensor) -> Known:
        """Some of the sequences."""
        return Known(self.acquisition[index_B], self.token[index_B], self.costly[index_B], self.target_cost[index_B])


class BudgetedPolicy(nn.Module, ABC):
    """π̂ and π̃; raw numbers in, probabilities and bin logits out."""

    owner: Tensor
    wave_number: Tensor  # free number that each wave is of
    wave_frequency: Tensor

    def __init__(self, config: ModelConfig, memory: int) -> None:
        """`memory`: numbers that the acquisition head reads of the past, 0 for none."""
        super().__init__()
        self.config, self.memory_width = config, memory
        waves = [(i, math.pi / 2 * 2**k) for i, octaves in enumerate(config.octaves) for k in range(octaves)]
        n_costly, n_context = len(config.owner), config.n_free + 2 * len(waves) + 1
        self.register_buffer("owner", torch.tensor(config.owner, dtype=torch.long))
        self.register_buffer("wave_number", torch.tensor([i for i, _ in waves], dtype=torch.long))
        self.register_buffer("wave_frequency", torch.tensor([frequency for _, frequency in waves]))
        self.normalise_free = Normalisation(config.n_free)
        self.normalise_costly = Normalisation(n_costly)
        self.normalise_return = Normalisation(1)
        self.encode_acquired = nn.Linear(n_costly + config.n_queries, config.encoder_width, bias=False)
        self.encode_context = nn.Linear(n_context, config.encoder_width)
        n_cost = 1 + 2 * COST_OCTAVES if config.budget_conditioned else 0
        self.acquisition_head = AcquisitionHead(memory, n_context + n_cost, config)
        self.action_head = _action_head(config)

    def context(self, free: Tensor, returns_to_go: Tensor) -> Tensor:
        """Free features [..., F] with their Fourier octaves, and the return-to-go [..., 1]: known before the query."""
        z = self.normalise_free(free)
        waves = z.index_select(-1, self.wave_number) * self.wave_frequency
        togo = self.normalise_return(returns_to_go)
        togo = togo if self.config.reads_returns else torch.zeros_like(togo)
        return torch.cat([z, torch.sin(waves), torch.cos(waves), togo], dim=-1)

    def know(self, free: Tensor, returns_to_go: Tensor, target_cost: Tensor, costly: Tensor | None = None) -> Known:
        """All that does not depend on the query: free [..., F], returns_to_go [..., 1], target_cost C [..., 1], and
        costly [..., D] (None where only the query is wanted)."""
        context = self.context(free, returns_to_go)
        limits = self.config.cost_range
        before = context if limits is None else torch.cat([context, _cost_waves(target_cost, *limits)], -1)
        normalised = free[..., :0] if costly is None else self.normalise_costly(costly)
        return Known(self.acquisition_head.from_context(before), self.encode_context(context), normalised, target_cost)

    def query_probs(self, memory: Tensor, known: Known) -> Tensor:
        """q̃_t, the Bernoulli means of the query, [..., M]; C itself where acquisition is random, ones or zeros where
        it is forced."""
        logits = self.acquisition_head(memory, known.acquisition)
        match self.config.acquisition:
            case "learned":
                return torch.sigmoid(logits)
            case "random":
                return torch.zeros_like(logits) + known.target_cost
        return torch.zeros_like(logits) + float(self.config.acquisition == "all")

    def encode(self, known: Known, query: Tensor) -> Tensor:
        """First hidden layer of W[q_t∘o_t, q_t, free_t, R_t], [..., E]; values not acquired cannot enter."""
        acquired = known.costly * query.index_select(-1, self.owner)
        mixed = known.token + self.encode_acquired(torch.cat([acquired, query], dim=-1))
        return torch.relu(mixed)

    @abstractmethod
    def hiddens(self, known: Known, query_BTM: Tensor) -> Tensor:
        """The state that the action head reads at every timestep, [B, T, W]."""

    @abstractmethod
    def memory(self, hidden_BTW: Tensor) -> Tensor:
        """What the acquisition head reads of the past at every timestep, [B, T, memory]."""


def _action_head(config: ModelConfig) -> ActionHead:
    if not config.bins:
        return GaussianHead(config.width, config.low, config.high)
    return BinsHead(config.width, config.bins, config.low, config.high, config.sampled)


def _cost_waves(target_cost: Tensor, low: float, high: float) -> Tensor:
    """C on a logarithmic scale, 0 to 1 over the range that was trained, with sines and cosines of it, [..., 7]. What
    lies outside is taken for the nearer end: no network knows what it was never asked."""
    z = torch.log(target_cost.clamp(low, high) / low) / math.log(high / low)
    waves = [wave(z * math.pi * 2**k) for k in range(COST_OCTAVES) for wave in (torch.sin, torch.cos)]
    return torch.cat([z, *waves], dim=-1)
