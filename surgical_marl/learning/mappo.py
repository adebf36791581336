"""Multi-agent PPO on rsl_rl (Yu et al. 2022, arXiv 2103.01955).

The agent axis lives inside the tensors. Observations of an agent type are `[N, n, d]`, the joint
action is flat `[N, sum]`, and log-probabilities, values, rewards and advantages are `[N, A]`. With
one agent (A = 1) this is PPO, by the same code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning import distributed
from surgical_marl.learning.constraint import Constraint
from surgical_marl.learning.normaliser import share_normalisers
from surgical_marl.learning.storage import MultiAgentStorage
from surgical_marl.learning.values import ValueScale
from surgical_marl.policies.networks import (
    MultiAgentActor,
    MultiAgentModel,
    actor_config,
    make_model,
    network_config,
)
from surgical_marl.policies.recurrent import Memory
from surgical_marl.runs.settings import Settings

LOSSES = ("value_loss", "surrogate_loss", "entropy", "kl", "learning_rate")
LEARNING_RATE_RANGE = (1e-5, 1e-2)  # rsl_rl's limits of the adaptive learning rate


class MAPPO(PPO):
    """PPO with a ratio for each agent, and a critic with a value for each agent.

    `update` is not rsl_rl's for two reasons: rsl_rl's squeezes are wrong for A = 1, and it waits
    for the device some hundred times an update where this never waits: a CUDA graph can hold it
    (see `learn`).

    Args:
        team_reward: give every agent the sum of all agents' rewards, instead of its own.
        normalise_values: the critic predicts returns of unit variance; all else is in units of reward.
        constraint: on a cost; the critic then has two values for each agent, of rewards and of costs.
        ppo: arguments of `rsl_rl.algorithms.PPO`.
    """

    def __init__(
        self,
        actor: Any,
        critic: Any,
        storage: MultiAgentStorage,
        *,
        team_reward: bool = False,
        normalise_values: bool = False,
        constraint: Constraint | None = None,
        **ppo: Any,
    ) -> None:
        super().__init__(actor, critic, storage, **ppo)
        self.storage: MultiAgentStorage = storage
        self.team_reward = team_reward
        self.scale = ValueScale(storage.values.shape[-1]).to(self.device)
        # What learns beside the networks: it stands in checkpoints.
        self.options = nn.ModuleDict({"scale": self.scale} if normalise_values else {})
        self.memory = Memory(storage.num_envs, actor, critic, self.device)
        self.constraint = constraint
        if constraint is not None:
            self.options["constraint"] = constraint
        # As a tensor the learning rate adapts without the host having to read the divergence.
        self._rate = torch.tensor(float(self.learning_rate), device=self.device)
        self._cuda = torch.device(self.device).type == "cuda"
        self.optimizer = torch.optim.Adam(self.parameters(), lr=self._rate, fused=True, capturable=self._cuda)

    def act(self, obs: TensorDict) -> Tensor:
        """Sample the flat joint action `[N, sum]`."""
        step, memory = self.transition, self.memory
        if self.storage.step == 0:
            memory.begin()
        with self._precision():
            step.actions = self.actor(obs, None, memory.actor, stochastic_output=True)
            step.actions_log_prob = self.actor.get_output_log_prob(step.actions)
        step.values = self._values(obs)
        memory.step()
        step.distribution_params = self.actor.output_distribution_params
        step.observations = obs
        return step.actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]) -> None:
        """Store one step.

        A time-out is worth the value of the state it was cut off in: gamma * V(final state).
        """
        parts = [extras["agent_rewards"]]
        if self.constraint is not None:
            parts.append(self.constraint.add(extras["infos"], dones))
        rewards = torch.stack(parts, -1)
        if self.team_reward:
            rewards = rewards.sum(-2, keepdim=True).expand_as(rewards)
        rewards = rewards.flatten(-2)
        final_values = self._values(extras["final_obs"])
        self.transition.rewards = rewards + self.gamma * final_values * extras["time_outs"].unsqueeze(-1)
        self.transition.dones = dones
        self.storage.add_transition(self.transition)
        self.transition.clear()
        self.memory.clear(dones)

    def loss(self, batch: RolloutStorage.Batch) -> tuple[Tensor, Tensor]:
        """Loss of a mini-batch; and value loss, surrogate loss, entropy and KL, detached `[4]`."""
        actor_memory, critic_memory = batch.hidden_states
        self.actor.distribute(batch.observations, batch.masks, actor_memory)
        log_prob = self.actor.get_output_log_prob(batch.actions)
        with torch.no_grad():
            params = self.actor.output_distribution_params
            divergence = self.actor.get_kl_divergence(batch.old_distribution_params, params).mean()
        entropy = self.actor.output_entropy.mean()

        ratio = torch.exp(log_prob - batch.old_actions_log_prob)
        clipped = ratio.clamp(1 - self.clip_param, 1 + self.clip_param)
        surrogate = -torch.min(batch.advantages * ratio, batch.advantages * clipped).mean()

        values = self.critic(batch.observations, batch.masks, critic_memory)
        returns = self.scale.normalise(batch.returns)
        value = (values - returns).square()
        if self.use_clipped_value_loss:
            old = self.scale.normalise(batch.values)
            near = old + (values - old).clamp(-self.clip_param, self.clip_param)
            value = torch.max(value, (near - returns).square())
        value = value.mean()

        loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy
        return loss, torch.stack([value, surrogate, entropy, divergence]).detach()

    def compute_returns(self, obs: TensorDict) -> None:
        """Returns and normalised advantages of the stored rollout; `obs` is what comes after it."""
        storage = self.storage
        storage.compute_returns(self._values(obs), self.gamma, self.lam)
        if "scale" in self.options:
            self.scale.learn(storage.returns.flatten(0, 1))
        advantages = storage.returns - storage.values
        if self.constraint is not None:
            self.constraint.update()
            advantages = self.constraint.weigh(advantages.unflatten(-1, (-1, 2)))
        storage.advantages.copy_(distributed.standardised(advantages))

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout; returns mean losses, KL and the learning rate (see `LOSSES`)."""
        losses = dict(zip(LOSSES, self.learn().tolist(), strict=True))
        self.storage.clear()
        self.learning_rate = losses["learning_rate"]
        return losses

    def learn(self) -> Tensor:
        """What `update` does, without waiting for the device: `LOSSES` as a tensor."""
        total = torch.zeros(4, device=self.device)
        for batch in self._batches():
            with self._precision():
                loss, parts = self.loss(batch)
            self.optimizer.zero_grad()
            loss.backward()
            divergence = distributed.average_gradients(self.parameters(), parts[-1])
            if self.schedule == "adaptive":
                self._adapt_rate(divergence)
            for model in (self.actor, self.critic):
                nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
            self.optimizer.step()
            total += parts
        observations = self.storage.observations.flatten(0, 1)
        self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        count = self.num_mini_batches * self.num_learning_epochs
        return torch.cat([total / count, self._rate[None]])

    def parameters(self) -> list[nn.Parameter]:
        """All that the optimiser changes."""
        return [*self.actor.parameters(), *self.critic.parameters()]

    def _batches(self) -> Iterator[RolloutStorage.Batch]:
        counts = (self.num_mini_batches, self.num_learning_epochs)
        if self.actor.is_recurrent:
            return self.storage.sequences(self.memory.begun, *counts)
        return self.storage.mini_batch_generator(*counts)

    def _values(self, obs: TensorDict) -> Tensor:
        """Values of observations, in units of reward."""
        with self._precision():
            return self.scale.restore(self.critic(obs, None, self.memory.critic))

    def _precision(self) -> torch.autocast:
        """bfloat16 for the networks' products if that was asked for; the same when acting and learning, or ratios
        would not begin at 1."""
        enabled = self.use_mixed_precision and self._cuda
        return torch.autocast("cuda" if self._cuda else "cpu", torch.bfloat16, enabled=enabled)

    def _adapt_rate(self, divergence: Tensor) -> None:
        """rsl_rl's rule: slower above twice the wanted divergence, faster below half of it."""
        low, high = LEARNING_RATE_RANGE
        slower = (self._rate / 1.5).clamp(min=low)
        faster = (self._rate * 1.5).clamp(max=high)
        rate = torch.where((divergence < self.desired_kl / 2) & (divergence > 0), faster, self._rate)
        self._rate.copy_(torch.where(divergence > self.desired_kl * 2, slower, rate))

    def save(self) -> dict[str, Any]:
        """All that `load` needs to go on, as tensors and plain values."""
        return {**super().save(), "options_state_dict": self.options.state_dict()}

    def load(
        self,
        loaded_dict: dict[str, Any],
        load_cfg: dict[str, Any] | None = None,
        strict: bool = True,
    ) -> bool:
        """Load what `save` returned.

        The optimizer then holds its own copy of the learning rate: share it again.
        """
        result = super().load(loaded_dict, load_cfg, strict)
        self.options.load_state_dict(loaded_dict.get("options_state_dict", {}))
        group = self.optimizer.param_groups[0]
        group["lr"] = self._rate = torch.as_tensor(group["lr"], device=self.device)
        group["capturable"] = self._cuda  # the checkpoint may come from another kind of device
        return result

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: RslRlVecEnv, cfg: dict[str, Any], device: str) -> MAPPO:
        """Build the algorithm from an rsl_rl configuration (see `rsl_rl_config`), as rsl_rl's
        runner does it.
        """
        layout = env.layout
        options, constraint = dict(cfg["algorithm"]), None
        if bounds := options.pop("constraint"):
            constraint = Constraint(layout, env.num_envs, **bounds).to(device)
        per_agent = 1 if constraint is None else 2
        num_values = per_agent * layout.num_agents
        actor = MultiAgentActor(obs, layout.action_sizes, **cfg["actor"])
        if cfg["centralised_critic"]:
            critic: nn.Module = make_model(obs, ["state"], num_values, **cfg["critic"])
        else:
            critic = MultiAgentModel(obs, dict.fromkeys(layout.counts, per_agent), **cfg["critic"])
        for model in (actor, critic):
            share_normalisers(model)
        steps = cfg["num_steps_per_env"]
        sizes = (layout.num_agents, num_values, env.num_envs, steps)
        storage = MultiAgentStorage(*sizes, obs, env.num_actions, device)
        del options["class_name"]
        return MAPPO(actor.to(device), critic.to(device), storage, constraint=constraint, device=device, **options)


def rsl_rl_config(settings: Settings) -> dict[str, Any]:
    """The settings as a configuration that rsl_rl's own `OnPolicyRunner` also takes."""
    network, ppo = settings.network, settings.ppo
    return {
        "num_steps_per_env": settings.steps_per_iteration,
        "save_interval": settings.checkpoint_every,
        "centralised_critic": settings.algo != "ippo",
        "actor": actor_config(network),
        "critic": network_config(network),
        "algorithm": {
            "class_name": MAPPO,
            "team_reward": settings.team_reward,
            "normalise_values": ppo.normalise_values,
            "constraint": asdict(settings.constraint) if settings.constraint.cost != "none" else None,
            "learning_rate": ppo.learning_rate,
            "schedule": ppo.schedule,
            "desired_kl": ppo.desired_kl,
            "gamma": ppo.gamma,
            "lam": ppo.lam,
            "clip_param": ppo.clip,
            "use_clipped_value_loss": ppo.clip_value,
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": ppo.mini_batches,
            "value_loss_coef": ppo.value_coefficient,
            "entropy_coef": ppo.entropy_coefficient,
            "max_grad_norm": ppo.max_gradient_norm,
            "use_mixed_precision": settings.precision == "bfloat16",
        },
    }
