"""The storage of a rollout, from which an update learns."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor


class MultiAgentStorage(RolloutStorage):
    """rsl_rl's rollout storage with log-probabilities and advantages A wide, and rewards, values and returns W wide.

    W is A, or 2 A where each agent has a reward and a cost: one after the other, agent by agent.
    """

    distribution_params: tuple[Tensor, ...] | None

    def __init__(
        self, num_agents: int, num_values: int, num_envs: int, steps: int, obs: TensorDict, actions: int, device: str
    ) -> None:
        super().__init__("rl", num_envs, steps, obs, [actions], device)
        for name in ("actions_log_prob", "advantages"):
            setattr(self, name, torch.zeros(steps, num_envs, num_agents, device=device))
        for name in ("rewards", "values", "returns"):
            setattr(self, name, torch.zeros(steps, num_envs, num_values, device=device))

    def add_transition(self, transition: RolloutStorage.Transition) -> None:
        """Copy one step of all environments into the storage."""
        if self.step >= self.num_transitions_per_env:
            raise OverflowError(f"the storage holds {self.num_transitions_per_env} steps: clear() it first")
        for name in ("observations", "actions", "rewards", "values", "actions_log_prob"):
            getattr(self, name)[self.step].copy_(getattr(transition, name))
        self.dones[self.step].copy_(transition.dones.unsqueeze(-1))
        params = transition.distribution_params or ()
        if self.distribution_params is None:
            steps = self.num_transitions_per_env
            self.distribution_params = tuple(param.new_zeros(steps, *param.shape) for param in params)
        for stored, param in zip(self.distribution_params, params, strict=True):
            stored[self.step].copy_(param)
        self.step += 1

    def sequences(
        self, begun: tuple[Tensor, Tensor], num_mini_batches: int, num_epochs: int
    ) -> Iterator[RolloutStorage.Batch]:
        """Yield mini-batches `[T, B]` for recurrent networks: whole rollouts of B environments each.

        Args:
            begun: memories of actor and critic where the rollout began, `[N, ...]` each.
            num_mini_batches: in an epoch, each of other environments.
            num_epochs: with the same mini-batches, as rsl_rl does.
        """
        begins = self.begins()
        order = torch.randperm(self.num_envs, device=self.device)
        for _ in range(num_epochs):
            for chosen in order.split(self.num_envs // num_mini_batches)[:num_mini_batches]:
                yield RolloutStorage.Batch(
                    observations=self.observations[:, chosen],
                    actions=self.actions[:, chosen],
                    values=self.values[:, chosen],
                    advantages=self.advantages[:, chosen],
                    returns=self.returns[:, chosen],
                    old_actions_log_prob=self.actions_log_prob[:, chosen],
                    old_distribution_params=tuple(param[:, chosen] for param in self.distribution_params or ()),
                    hidden_states=(begun[0][chosen], begun[1][chosen]),
                    masks=begins[:, chosen],
                )

    def begins(self) -> Tensor:
        """Return where in the rollout an episode begins, `[T, N]` bool: nowhere in its first step."""
        return torch.cat([torch.zeros_like(self.dones[:1]), self.dones[:-1]]).squeeze(-1).bool()

    def compute_returns(self, last_values: Tensor, gamma: float, lam: float) -> None:
        """Fill `returns` by generalised advantage estimation (Schulman et al. 2016, arXiv 1506.02438).

        Args:
            last_values: of the observations after the last step, as wide as values.
            gamma: discount of a step.
            lam: of the mixture of n-step returns, 0 for one step and 1 for whole episodes.
        """
        advantage, next_values = torch.zeros_like(last_values), last_values
        for step in reversed(range(self.num_transitions_per_env)):
            goes_on = 1.0 - self.dones[step].float()
            ahead = self.rewards[step] + goes_on * gamma * next_values - self.values[step]
            advantage = ahead + goes_on * gamma * lam * advantage
            next_values = self.values[step]
            self.returns[step] = advantage + next_values
