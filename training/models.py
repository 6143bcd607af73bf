"""The Budgeted Decision Transformer: a shared causal trunk, an action head and a split-off acquisition head.

This module knows nothing about losses, sampling or files. Shape letters: B batch, T time, W width, H heads, h head
width, K context length, L layers, S = K - 1 cached slots; F free numbers, M costly features, D costly numbers,
A action components.

Token layout (one token a timestep; departs from the paper's three a timestep, see docs/adr/0001): the normalised
acquired values `q∘o`, the query `q`, the free features and the return-to-go R. The previous action is left out
(copycat: it lowers the loss and the return).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["BudgetedDecisionTransformer", "ModelConfig", "Normalisation", "sliding_ages"]

_MASKED = -1e9


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of one network."""

    n_free: int  # F
    owner: tuple[int, ...]  # costly feature that each of the D costly numbers belongs to
    n_queries: int  # M
    bins: tuple[int, ...]  # bins of each action component, A of them
    low: tuple[float, ...]  # lowest value of each action component
    high: tuple[float, ...]  # highest value of each action component
    sampled: tuple[bool, ...]  # True: the component is sampled from its bins, False: the most probable bin is taken
    context_length: int = 20  # K, the attention span in timesteps
    width: int = 64  # W
    n_layers: int = 2  # L
    n_heads: int = 4  # H
    encoder_width: int = 128  # hidden width of the token encoder and of the acquisition head
    fourier: int = 4  # sine/cosine octaves of each free number: positions must be told apart finely
    acquisition: str = "learned"  # learned | all | none: whether queries are learned, or forced to ones or zeros
    acquisition_bias: float = 0.0  # initial logit of every query probability


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


def sliding_ages(length: int, device: torch.device | None = None) -> Tensor:
    """Age of key j seen from query i, shape [T, T]; negative for the future."""
    steps = torch.arange(length, device=device)
    return steps[:, None] - steps[None, :]


class Attention(nn.Module):
    """Multi-head attention over a sliding span of K timesteps, with a learned bias by age instead of positions."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.n_heads, self.head_dim = config.n_heads, config.width // config.n_heads
        self.context_length = config.context_length
        self.qkv = nn.Linear(config.width, 3 * config.width)
        self.out = nn.Linear(config.width, config.width)
        self.age_bias = nn.Parameter(torch.zeros(config.n_heads, config.context_length))

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values of tokens [..., W], each shape [..., H, h]."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.n_heads, self.head_dim)).unbind(-3)
        return q, k, v

    def bias(self) -> Tensor:
        """Score added at each age, shape [H, K + 1]; the last column masks an empty slot."""
        return functional.pad(self.age_bias, (0, 1), value=_MASKED)

    def forward(self, x_BTW: Tensor) -> Tensor:
        q, k, v = (y.transpose(1, 2) for y in self.project(x_BTW))  # each [B, H, T, h]
        ages_TT = sliding_ages(x_BTW.shape[1], x_BTW.device)
        ages_TT = torch.where((ages_TT >= 0) & (ages_TT < self.context_length), ages_TT, self.context_length)
        bias_HTT = self.bias().index_select(1, ages_TT.flatten()).unflatten(1, ages_TT.shape)
        mixed_BHTh = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias_HTT)
        return self.out(mixed_BHTh.transpose(1, 2).flatten(2))

    def step(
        self, x_NW: Tensor, keys_NHSh: Tensor, values_NHSh: Tensor, ages_NS: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One timestep over cached keys and values; equals the last row of `forward` over the same history."""
        q, k, v = self.project(x_NW)  # each [N, H, h]
        scale = 1.0 / math.sqrt(self.head_dim)
        bias = self.bias()
        cached_NHS = (keys_NHSh @ (q * scale)[..., None])[..., 0] + bias[:, ages_NS].transpose(0, 1)
        # The new token is scored beside the cache: nothing is concatenated but scores.
        own_NH1 = ((q * scale) * k).sum(-1, keepdim=True) + bias[:, :1]
        weights = torch.softmax(torch.cat([cached_NHS, own_NH1], dim=-1), dim=-1)
        mixed_NHh = (weights[..., None, :-1] @ values_NHSh)[..., 0, :] + weights[..., -1:] * v
        return self.out(mixed_NHh.flatten(1)), k, v


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.attention = Attention(config)
        self.norm_attention = nn.LayerNorm(config.width)
        self.norm_mlp = nn.LayerNorm(config.width)
        self.mlp = nn.Sequential(
            nn.Linear(config.width, 4 * config.width),
            nn.GELU(approximate="tanh"),
            nn.Linear(4 * config.width, config.width),
        )

    def forward(self, x_BTW: Tensor) -> Tensor:
        x_BTW = x_BTW + self.attention(self.norm_attention(x_BTW))
        return x_BTW + self.mlp(self.norm_mlp(x_BTW))

    def step(self, x_NW: Tensor, keys: Tensor, values: Tensor, ages_NS: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mixed, key, value = self.attention.step(self.norm_attention(x_NW), keys, values, ages_NS)
        x_NW = x_NW + mixed
        return x_NW + self.mlp(self.norm_mlp(x_NW)), key, value


class BudgetedDecisionTransformer(nn.Module):
    """π̂ (acquisition head) and π̃ (action head) over one trunk; raw numbers in, probabilities and bin logits out."""

    owner: Tensor

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        n_costly = len(config.owner)
        self.register_buffer("owner", torch.tensor(config.owner, dtype=torch.long))
        self.normalise_free = Normalisation(config.n_free)
        self.normalise_costly = Normalisation(n_costly)
        self.normalise_return = Normalisation(1)
        n_context = config.n_free * (1 + 2 * config.fourier) + 1
        self.encode_token = nn.Sequential(
            nn.Linear(n_costly + config.n_queries + n_context, config.encoder_width),
            nn.GELU(approximate="tanh"),
            nn.Linear(config.encoder_width, config.width),
        )
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        self.norm_out = nn.LayerNorm(config.width)
        self.action_head = nn.Linear(config.width, sum(config.bins))
        self.acquisition_head = nn.Sequential(
            nn.Linear(config.width + n_context, config.encoder_width),
            nn.GELU(approximate="tanh"),
            nn.Linear(config.encoder_width, config.n_queries),
        )
        self._init_weights()

    def _init_weights(self) -> None:
        for block in self.blocks:
            for last in (block.attention.out, block.mlp[-1]):
                nn.init.normal_(last.weight, std=0.02 / math.sqrt(2 * self.config.n_layers))
                nn.init.zeros_(last.bias)
        nn.init.zeros_(self.acquisition_head[-1].weight)
        nn.init.constant_(self.acquisition_head[-1].bias, self.config.acquisition_bias)

    def context(self, free: Tensor, returns_to_go: Tensor) -> Tensor:
        """Free features [..., F] with their Fourier octaves, and the return-to-go [..., 1]: known before the query."""
        z = self.normalise_free(free)
        octaves = [z] + [
            wave(z * (math.pi / 2) * 2**k) for k in range(self.config.fourier) for wave in (torch.sin, torch.cos)
        ]
        return torch.cat([*octaves, self.normalise_return(returns_to_go)], dim=-1)

    def tokens(self, context: Tensor, costly: Tensor, query: Tensor) -> Tensor:
        """x_t = W[q_t∘o_t, q_t, free_t, R_t], shape [..., W]; values that were not acquired cannot enter."""
        acquired = self.normalise_costly(costly) * query.index_select(-1, self.owner)
        return self.encode_token(torch.cat([acquired, query, context], dim=-1))

    def trunk(self, x_BTW: Tensor) -> Tensor:
        """h_t for every timestep, [B, T, W]."""
        for block in self.blocks:
            x_BTW = block(x_BTW)
        return self.norm_out(x_BTW)

    def query_logits(self, previous_hidden: Tensor, context: Tensor) -> Tensor:
        """Logits of q̃_t = π̂(h_{t-1}, free_t, R_t), [..., M]."""
        return self.acquisition_head(torch.cat([previous_hidden, context], dim=-1))

    def query_probs(self, previous_hidden: Tensor, context: Tensor) -> Tensor:
        """q̃_t, the Bernoulli means of the query, [..., M]; ones or zeros where acquisition is not learned."""
        logits = self.query_logits(previous_hidden, context)
        if self.config.acquisition == "learned":
            return torch.sigmoid(logits)
        return torch.zeros_like(logits) + float(self.config.acquisition == "all")

    def action_logits(self, hidden: Tensor) -> list[Tensor]:
        """Logits over the bins of each action component: A tensors [..., bins]."""
        return list(self.action_head(hidden).split(self.config.bins, dim=-1))

    def actions(self, hidden: Tensor, noise: Tensor) -> Tensor:
        """Raw action numbers [..., A]; `noise` [..., A] uniform in [0, 1) drives the components that are sampled."""
        config = self.config
        chosen = []
        for i, logits in enumerate(self.action_logits(hidden)):
            if config.sampled[i]:
                cumulative = torch.softmax(logits, dim=-1).cumsum(-1)
                bin_ = (noise[..., i : i + 1] >= cumulative[..., :-1]).to(logits.dtype).sum(-1)
            else:
                bin_ = logits.argmax(-1).to(logits.dtype)
            chosen.append(config.low[i] + bin_ * ((config.high[i] - config.low[i]) / (config.bins[i] - 1)))
        return torch.stack(chosen, dim=-1)

    @staticmethod
    def shift(hidden_BTW: Tensor) -> Tensor:
        """h_{t-1} for every t: zeros before the first turn."""
        return functional.pad(hidden_BTW[:, :-1], (0, 0, 1, 0))
