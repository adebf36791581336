"""Statistics of the episodes that end while training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


class Episodes:
    """Statistics of the episodes that end, summed on the device.

    Attributes:
        collided: `[N]` bool, whether the running episode of each environment had a collision so
            far.
    """

    def __init__(self, agents: Sequence[str], num_envs: int, device: str) -> None:
        self.agents = list(agents)
        self.collided = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._totals = torch.zeros(5, device=device)

    def add(self, rewards: Tensor, dones: Tensor, infos: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Count one step: rewards `[N]`, dones `[N]`, and the infos of each agent."""
        error, success, collision = (
            torch.stack([infos[agent][name] for agent in self.agents]) for name in ("tip_error", "success", "collision")
        )
        self.collided |= collision.any(0)
        # where, not a product: the error of an episode that runs on must not matter, whatever it
        # is.
        ended = torch.stack(
            [
                torch.ones_like(rewards),
                error.mean(0),
                success.float().mean(0),
                self.collided.float(),
            ]
        )
        sums = torch.where(dones, ended, 0.0).sum(-1)
        self._totals += torch.cat([sums, rewards.mean()[None]])
        self.collided &= ~dones

    def take(self) -> Tensor:
        """Sums since the last call: episodes, errors (m), successes, collisions, rewards."""
        totals = self._totals.clone()
        self._totals.zero_()
        return totals
