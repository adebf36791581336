"""What a rollout leaves for the update to learn from."""

from __future__ import annotations

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor


class MultiAgentStorage(RolloutStorage):
    """rsl_rl's rollout storage with log-probabilities, values, rewards and advantages A wide."""

    distribution_params: tuple[Tensor, ...] | None

    def __init__(self, num_agents: int, num_envs: int, steps: int, obs: TensorDict, actions: int, device: str) -> None:
        super().__init__("rl", num_envs, steps, obs, [actions], device)
        for name in ("rewards", "values", "actions_log_prob", "returns", "advantages"):
            setattr(self, name, torch.zeros(steps, num_envs, num_agents, device=device))

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
