"""Running statistics: of observations, and of returns, so that a critic predicts values of unit variance."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from surgical_marl.learning import distributed
from surgical_marl.policies.networks import LimitedNormaliser

DECAY = 0.99
"""Decay of the weights of older iterations: the statistics are of about the last hundred iterations."""
LEAST_STD = 0.01
"""Least standard deviation of returns, in units of reward, so that returns that hardly differ are not amplified."""


class ValueScale(nn.Module):
    """Mean and standard deviation of each value's returns (value normalisation, Yu et al. 2022, arXiv 2103.01955).

    Until `learn` is called it changes nothing. Its update is in place and never waits for the host, so that a CUDA
    graph can repeat it.

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
        """Update the exponential averages with the returns `[B, W]` of an iteration."""
        self.weight.mul_(DECAY).add_(1.0)
        variance, mean = distributed.var_mean(returns, dim=0)
        ahead = mean - self.mean
        self.mean += ahead / self.weight
        self.variance += (variance - self.variance + ahead * (mean - self.mean)) / self.weight
        self.std.copy_(self.variance.sqrt().clamp(min=LEAST_STD))

    def normalise(self, values: Tensor) -> Tensor:
        """Return values or returns `[..., W]`, given in units of reward, as the critic should predict them."""
        return (values - self.mean) / self.std

    def restore(self, predicted: Tensor) -> Tensor:
        """Return the critic's predictions, `[..., W]`, in units of reward."""
        return predicted * self.std + self.mean


class Normaliser(LimitedNormaliser):
    """A normaliser with an update in place that a CUDA graph can repeat."""

    def update(self, x: Tensor) -> None:
        """Learn from the batches `[B, d]` of all processes while training."""
        if not self.training:
            return
        count = x.shape[0] * distributed.size()
        var, mean = distributed.var_mean(x, dim=0)
        self.count += count
        rate = count / self.count
        ahead = mean - self._mean
        self._mean += rate * ahead
        self._var += rate * (var - self._var + ahead * (mean - self._mean))
        self._std.copy_(self._var.sqrt())


def share_normalisers(network: nn.Module) -> None:
    """Replace every normaliser of observations in a network that is to learn by a `Normaliser`."""
    for model in network.modules():
        if getattr(model, "obs_normalization", False):
            model.obs_normalizer = Normaliser(model.obs_dim)
