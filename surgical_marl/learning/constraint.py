"""A limit on the share of episodes with a cost, by a Lagrange multiplier that a PID controller adapts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from surgical_marl.learning import distributed
from surgical_marl.policies.layout import Layout

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

METRICS = ("cost_rate", "lagrange_multiplier")
"""Names of the values of `Constraint.metrics`."""


def check_cost(cost: str, env: BatchedEnv) -> None:
    """Raise ValueError for the cost of an overload of tissue in a scene that has none."""
    if cost == "tissue" and not any("tissue_force" in system.reports for system in env.scene.systems.values()):
        raise ValueError(f"constraint.cost must not be 'tissue' in scene {env.scene.name!r}, which has no tissue")


class Constraint(nn.Module):
    """The multiplier of a cost (Stooke et al. 2020, arXiv 2007.03964, algorithm 2).

    The limit is on the share of episodes in which any agent had the cost in any step; for `collision` this is the
    `collision_rate` of the metrics. `multiplier` is subtracted from the reward in every step with the cost. All state
    stays in place and nothing waits for the host, so that a CUDA graph can repeat it.

    Args:
        layout: of the environment, which stacks costs as it does rewards.
        num_envs: N.
        cost: "collision", or the name of a limit in `surgical_marl/envs/infos.py`.
        limit: the share of episodes that may have it, 0 to 1.
        kp, ki, kd: gains of the controller: for the excess over the limit, for its sum over iterations, and for its
            growth since the last iteration.

    Attributes:
        multiplier: weight of a step's cost, in units of reward, [].
        integral: sum of the excess over iterations, never below 0, [].
        rate: share of episodes that had the cost, of those that ended in the last iteration in which any did, [].
        broken: whether the running episode of each environment had the cost so far, [N] bool.
    """

    multiplier: Tensor
    integral: Tensor
    rate: Tensor
    broken: Tensor
    _ended: Tensor

    def __init__(
        self, layout: Layout, num_envs: int, *, cost: str, limit: float, kp: float, ki: float, kd: float
    ) -> None:
        super().__init__()
        self._layout, self._info = layout, cost if cost == "collision" else f"cost_{cost}"
        self.limit, self.kp, self.ki, self.kd = limit, kp, ki, kd
        for name in ("multiplier", "integral", "rate"):
            self.register_buffer(name, torch.zeros(()))
        # these two are of this process: `Trainer` saves the first, and the second is zero between iterations
        self.register_buffer("broken", torch.zeros(num_envs, dtype=torch.bool), persistent=False)
        # episodes since the last update: all that ended, and those that had the cost
        self.register_buffer("_ended", torch.zeros(2), persistent=False)

    def add(self, infos: Mapping[str, Mapping[str, Tensor]], dones: Tensor) -> Tensor:
        """Count a step of all environments; return the costs of acting agents `[N, A]`."""
        costs = self._layout.rewards({agent: info[self._info].float() for agent, info in infos.items()})
        self.broken |= (costs > 0).any(-1)
        self._ended += torch.stack([dones, dones & self.broken]).float().sum(-1)
        self.broken &= ~dones
        return costs

    def update(self) -> None:
        """Adapt the multiplier to the episodes of all processes that ended since the last call, if there were any."""
        ended, broken = distributed.total(self._ended)
        rate = broken / ended.clamp(min=1.0)
        excess, growth = rate - self.limit, (rate - self.rate).clamp(min=0.0)
        integral = (self.integral + excess).clamp(min=0.0)
        multiplier = (self.kp * excess + self.ki * integral + self.kd * growth).clamp(min=0.0)
        for kept, new in ((self.multiplier, multiplier), (self.integral, integral), (self.rate, rate)):
            kept.copy_(torch.where(ended > 0, new, kept))
        self._ended.zero_()

    def weigh(self, advantages: Tensor) -> Tensor:
        """Return the advantages of the Lagrangian, `[...]`, from those of reward and of cost, `[..., 2]`.

        They are divided by 1 + multiplier, so that a large multiplier does not cause a large step.
        """
        reward, cost = advantages.unbind(-1)
        return (reward - self.multiplier * cost) / (1.0 + self.multiplier)

    def metrics(self) -> Tensor:
        """Return `METRICS` of the last update, `[2]`."""
        return torch.stack([self.rate, self.multiplier])
