"""Running mean and variance of observations."""

from __future__ import annotations

from torch import Tensor, nn

from surgical_marl.learning import distributed
from surgical_marl.policies.normaliser import LimitedNormaliser


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
