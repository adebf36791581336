"""The scale of values: a critic that predicts returns of unit variance, whatever the reward's unit."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from surgical_marl.learning import distributed

DECAY = 0.99
"""What an iteration's returns count of the next one's: the statistics are of about the last hundred iterations."""
LEAST_STD = 0.01
"""Returns that hardly differ are not blown up beyond this, in units of reward."""


class ValueScale(nn.Module):
    """Mean and standard deviation of each value's returns (value normalisation, Yu et al. 2022, arXiv 2103.01955).

    Until `learn` is called it changes nothing. What it learns stays in place and asks the host for nothing, so that a
    CUDA graph can repeat it.

    Args:
        width: how many values there are, W.
    """

    weight: Tensor
    mean: Tensor
    variance: Tensor
    std: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("weight", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("variance", torch.ones(width))
        self.register_buffer("std", torch.ones(width))

    def learn(self, returns: Tensor) -> None:
        """Take in the returns `[B, W]` of an iteration, as an exponential average whose first one counts in full."""
        self.weight.mul_(DECAY).add_(1.0)
        variance, mean = distributed.var_mean(returns, dim=0)
        ahead = mean - self.mean
        self.mean += ahead / self.weight
        self.variance += (variance - self.variance + ahead * (mean - self.mean)) / self.weight
        self.std.copy_(self.variance.sqrt().clamp(min=LEAST_STD))

    def normalise(self, values: Tensor) -> Tensor:
        """Values or returns `[..., W]` in units of reward, as the critic is to predict them."""
        return (values - self.mean) / self.std

    def restore(self, predicted: Tensor) -> Tensor:
        """Return what the critic predicts, `[..., W]`, in units of reward."""
        return predicted * self.std + self.mean
