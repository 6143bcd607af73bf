"""The Budgeted Decision Transformer: one causal trunk under the acquisition head and the action head.

This module knows nothing about losses, sampling or files. Shape letters: B batch, T time, W width, H heads, G heads of
keys and values, h head width, K context length, L layers, S = K - 1 cached slots; M costly features; the others as in
`training.policy`.

Token layout (one token a timestep; departs from the paper's three a timestep, see docs/adr/0001): the normalised
acquired values `q∘o`, the query `q`, the free features and the return-to-go R. The previous action is left out
(copycat: it lowers the loss and the return).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from training.policy import BudgetedPolicy, Known, ModelConfig

__all__ = ["BudgetedDecisionTransformer", "sliding_ages"]

_MASKED = -1e9


def sliding_ages(length: int, device: torch.device | None = None) -> Tensor:
    """Age of key j seen from query i, shape [T, T]; negative for the future."""
    steps = torch.arange(length, device=device)
    return steps[:, None] - steps[None, :]


class Attention(nn.Module):
    """Attention over a sliding span of K timesteps, with a learned bias by age, of each head, instead of positions.

    H heads of queries share G heads of keys and values, H/G in a row each (grouped-query attention, Ainslie et al.,
    EMNLP 2023; one for all: Shazeer, 2019).
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.n_heads, (self.n_kv_heads, self.head_dim) = config.n_heads, config.token
        self.context_length = config.context_length
        self.qkv = nn.Linear(config.width, (self.n_heads + 2 * self.n_kv_heads) * self.head_dim)
        self.out = nn.Linear(config.width, config.width)
        self.age_bias = nn.Parameter(torch.zeros(config.n_heads, config.context_length))

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries [..., H, h], keys and values [..., G, h] of tokens [..., W]."""
        heads = self.qkv(x).unflatten(-1, (-1, self.head_dim))
        q, k, v = heads.split([self.n_heads, self.n_kv_heads, self.n_kv_heads], dim=-2)
        return q, k, v

    def bias(self) -> Tensor:
        """Score added at each age, shape [H, K + 1]; the last column masks an empty slot."""
        return functional.pad(self.age_bias, (0, 1), value=_MASKED)

    def forward(self, x_BTW: Tensor) -> Tensor:
        q, k, v = (y.transpose(1, 2) for y in self.project(x_BTW))  # [B, H, T, h], twice [B, G, T, h]
        shared = self.n_heads // self.n_kv_heads
        k, v = (y[:, :, None].expand(-1, -1, shared, -1, -1).flatten(1, 2) for y in (k, v))
        ages_TT = sliding_ages(x_BTW.shape[1], x_BTW.device)
        ages_TT = torch.where((ages_TT >= 0) & (ages_TT < self.context_length), ages_TT, self.context_length)
        bias_HTT = self.bias().index_select(1, ages_TT.flatten()).unflatten(1, ages_TT.shape)
        mixed_BHTh = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias_HTT)
        return self.out(mixed_BHTh.transpose(1, 2).flatten(2))

    def step(
        self, x_NW: Tensor, keys_NGSh: Tensor, values_NGSh: Tensor, ages_NS: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One timestep over cached keys and values; equals the last row of `forward` over the same history."""
        q, k, v = self.project(x_NW)  # [N, H, h], twice [N, G, h]
        q_NGRh = (q / math.sqrt(self.head_dim)).unflatten(1, (self.n_kv_heads, -1))  # R = H/G that share
        bias = self.bias().unflatten(0, q_NGRh.shape[1:3])
        cached_NGRS = q_NGRh @ keys_NGSh.transpose(-1, -2) + bias[:, :, ages_NS].movedim(2, 0)
        # The new token is scored beside the cache: nothing is concatenated but scores.
        own_NGR1 = (q_NGRh * k[:, :, None]).sum(-1, keepdim=True) + bias[..., :1]
        weights = torch.softmax(torch.cat([cached_NGRS, own_NGR1], dim=-1), dim=-1)
        mixed_NGRh = weights[..., :-1] @ values_NGSh + weights[..., -1:] * v[:, :, None]
        return self.out(mixed_NGRh.flatten(1)), k, v


class Block(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.attention = Attention(config)
        self.norm_attention = nn.LayerNorm(config.width)
        self.norm_mlp = nn.LayerNorm(config.width)
        self.mlp = nn.Sequential(
            nn.Linear(config.width, 4 * config.width),
            nn.ReLU(),
            nn.Linear(4 * config.width, config.width),
        )

    def forward(self, x_BTW: Tensor) -> Tensor:
        x_BTW = x_BTW + self.attention(self.norm_attention(x_BTW))
        return x_BTW + self.mlp(self.norm_mlp(x_BTW))

    def step(self, x_NW: Tensor, keys: Tensor, values: Tensor, ages_NS: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        mixed, key, value = self.attention.step(self.norm_attention(x_NW), keys, values, ages_NS)
        x_NW = x_NW + mixed
        return x_NW + self.mlp(self.norm_mlp(x_NW)), key, value


class BudgetedDecisionTransformer(BudgetedPolicy):
    """π̂ (acquisition head) and π̃ (action head) over one trunk; π̂ reads the trunk's state after the last turn."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config, memory=config.width)
        self.embed = nn.Linear(config.encoder_width, config.width)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.n_layers))
        self.norm_out = nn.LayerNorm(config.width)
        for block in self.blocks:
            for last in (block.attention.out, block.mlp[-1]):
                nn.init.normal_(last.weight, std=0.02 / math.sqrt(2 * config.n_layers))
                nn.init.zeros_(last.bias)

    def tokens(self, known: Known, query: Tensor) -> Tensor:
        """x_t = W[q_t∘o_t, q_t, free_t, R_t], shape [..., W]."""
        return self.embed(self.encode(known, query))

    def hiddens(self, known: Known, query_BTM: Tensor) -> Tensor:
        """h_t, the trunk's state at every timestep, [B, T, W]."""
        return self.trunk(self.tokens(known, query_BTM))

    def trunk(self, x_BTW: Tensor) -> Tensor:
        """h_t for tokens x_t, [B, T, W]."""
        for block in self.blocks:
            x_BTW = block(x_BTW)
        return self.norm_out(x_BTW)

    def memory(self, hidden_BTW: Tensor) -> Tensor:
        """h_{t-1} for every t: zeros before the first turn."""
        return functional.pad(hidden_BTW[:, :-1], (0, 0, 1, 0))
