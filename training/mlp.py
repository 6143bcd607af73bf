"""The memory-less baselines of the paper (BC, RCBC, and IQL's policy): a multi-layer perceptron on the frame alone.

This module knows nothing about losses, sampling or files. Shape letters as in `training.policy`.
"""

from __future__ import annotations

from torch import Tensor, nn

from training.policy import BudgetedPolicy, Known, ModelConfig

__all__ = ["BudgetedPerceptron"]


class BudgetedPerceptron(BudgetedPolicy):
    """π̂(q_t | free_t, R_t) and π̃(a_t | q_t(o_t), q_t, free_t, R_t): what a transformer of context size 1 sees."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config, memory=0)
        layers: list[nn.Module] = []
        for i in range(config.n_layers):
            layers += [nn.Linear(config.width if i else config.encoder_width, config.width), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def hiddens(self, known: Known, query_BTM: Tensor) -> Tensor:
        """The last hidden layer, [..., W]."""
        return self.layers(self.encode(known, query_BTM))

    def memory(self, hidden_BTW: Tensor) -> Tensor:
        """Nothing, [..., 0]."""
        return hidden_BTW[..., :0]
