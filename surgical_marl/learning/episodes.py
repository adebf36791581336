"""Statistics of training: of the episodes that end, and of each step's reward."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

ENDED = ("episodes", "error", "success", "collision", "reward")
"""Sums that `Episodes.take` returns before the reward terms. Errors are NaN in a task without tip errors."""
KNOWN = ("success", "collision")


class Episodes:
    """Sums over steps and episodes, on the device.

    Args:
        agents: names of the arms.
        terms: names of reward terms in the infos, such as "reward_distance".
        acting: number of acting agents, over which the mean reward of a step is taken; 1 with `joint`.

    Attributes:
        collided: `[N]` bool, whether the running episode of each environment had a collision so
            far.
        moved: `[N]` bool, whether the running episode went on from a state of the oracle. Such episodes count neither
            as successful nor as failed.
    """

    def __init__(self, agents: Sequence[str], terms: Sequence[str], acting: int, num_envs: int, device: str) -> None:
        self.agents, self.terms, self._acting = list(agents), list(terms), acting
        self.collided = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.moved = torch.zeros_like(self.collided)
        self._totals = torch.zeros(len(ENDED) + len(self.terms), device=device)

    def add(self, rewards: Tensor, dones: Tensor, infos: Mapping[str, Mapping[str, Tensor]], faulty: Tensor) -> None:
        """Count one step: rewards `[N]`, dones `[N]`, the infos of each agent, and where numbers are not finite `[N]`.

        An episode that ends by such a fault does not count, nor what is left of it in the next step.
        """
        success, collision = (torch.stack([infos[agent][name] for agent in self.agents]) for name in KNOWN)
        errors = [infos[agent]["tip_error"] for agent in self.agents if "tip_error" in infos[agent]]
        error = torch.stack(errors) if errors else torch.full_like(rewards, math.nan)[None]
        self.collided |= collision.any(0)
        # where, not a product: the error of an episode that runs on must not matter, whatever it
        # is.
        ended = torch.stack([torch.ones_like(rewards), error.mean(0), success.float().mean(0), self.collided.float()])
        sums = torch.where(dones & ~self.moved & ~faulty, ended, 0.0).sum(-1)
        self._totals += torch.cat([sums, rewards.mean()[None], self._mean_terms(infos, rewards)])
        self.collided &= ~dones
        self.moved &= ~dones
        self.moved |= faulty

    def move(self, moved: Tensor) -> None:
        """Note which environments, `[N]` bool, go on from another state now."""
        self.collided &= ~moved
        self.moved |= moved

    def _mean_terms(self, infos: Mapping[str, Mapping[str, Tensor]], rewards: Tensor) -> Tensor:
        """Return each reward term's part of the mean reward, `[T]`; it is 0 for an arm without the term."""
        if not self.terms:
            return rewards.new_zeros(0)
        nothing = torch.zeros_like(rewards)
        terms = [infos[agent].get(name, nothing) for name in self.terms for agent in self.agents]
        return torch.stack(terms).mean(-1).unflatten(0, (len(self.terms), -1)).sum(-1) / self._acting

    def take(self) -> Tensor:
        """Return the sums since the last call, and start again from zero.

        The sums are: episodes, errors (m), successes, collisions, rewards, and each term's part of the rewards.
        """
        totals = self._totals.clone()
        self._totals.zero_()
        return totals
