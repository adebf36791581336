"""The base of learning algorithms: multi-agent PPO on rsl_rl (Yu et al. 2022, arXiv 2103.01955).

The agent axis lives inside the tensors. Observations of a group of agents are `[N, n, d]`, the joint
action is flat `[N, sum]`, and log-probabilities, values, rewards and advantages are `[N, A]`. With
one agent (A = 1) this is PPO, by the same code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor, nn

from surgical_marl.interfaces.rsl_rl import RslRlVecEnv
from surgical_marl.learning import distributed
from surgical_marl.learning.constraint import Constraint, check_cost
from surgical_marl.learning.statistics import ValueScale, share_normalisers
from surgical_marl.learning.storage import MultiAgentStorage
from surgical_marl.policies.layout import Grouping
from surgical_marl.policies.networks import MultiAgentActor, MultiAgentModel, make_actor, make_model
from surgical_marl.policies.recurrent import Memory

if TYPE_CHECKING:
    from surgical_marl.learning.imitation import ImitationLoss

LOSSES = ("value_loss", "surrogate_loss", "entropy", "kl", "learning_rate")
LEARNING_RATE_RANGE = (1e-5, 1e-2)  # rsl_rl's limits of the adaptive learning rate


class Algorithm(PPO):
    """PPO with a ratio for each agent and a value for each agent; a subclass overrides what differs.

    A subclass may set `grouping` and `central_critic`, and override `surrogate`, `policy_loss`, `value_loss`, `loss`,
    `compute_returns`, or `parts` and `order`. Nothing in them may wait for the device, because an update becomes CUDA
    graphs.

    `update` is not rsl_rl's for two reasons: rsl_rl's squeezes are wrong for A = 1, and it waits for the device some
    hundred times per update, while this `update` never does.

    Args:
        actor: networks that act, a `MultiAgentActor`.
        critic: networks with a value for each agent, or two with a constraint.
        storage: of a rollout.
        team_reward: give every agent the sum of all agents' rewards, instead of its own.
        normalise_values: the critic predicts returns of unit variance; all else is in units of reward.
        constraint: on a cost; the critic then has two values for each agent, of rewards and of costs.
        ppo: arguments of `rsl_rl.algorithms.PPO`.

    Attributes:
        grouping: which agents share a network: those of a "type", none ("agent"), or "joint" for one agent that moves
            all arms (see `surgical_marl.policies.layout.Layout`).
        central_critic: whether the critic sees the whole state, instead of what each agent sees.
        losses: `LOSSES` of the last update, `[5]`; always at the same place in memory.
        gradients: sums of the gradient norms of actor and critic in the last update, `[2]`, likewise.
        before: mini-batches of it before the first gradient that was not finite, `[2]`, likewise.
        imitates: whether the actor has imitated demonstrations. Its observations are then normalised as those were:
            what it has learned would be lost if inputs were scaled anew, by what all environments see at the start.
        imitation: a loss beside that of the networks that act, or None.
    """

    grouping: ClassVar[Grouping] = "type"
    central_critic: ClassVar[bool] = True

    def __init__(
        self,
        actor: MultiAgentActor,
        critic: nn.Module,
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
        # Modules that learn besides the networks. Checkpoints contain them.
        self.options = nn.ModuleDict({"scale": self.scale} if normalise_values else {})
        self.memory = Memory(storage.num_envs, actor, critic, self.device)
        self.constraint = constraint
        if constraint is not None:
            self.options["constraint"] = constraint
        # As a tensor, so that the learning rate adapts without a transfer of the divergence to the host.
        self._rate = torch.tensor(float(self.learning_rate), device=self.device)
        self._cuda = torch.device(self.device).type == "cuda"
        self.optimizer = torch.optim.Adam(self.parameters(), lr=self._rate, fused=True, capturable=self._cuda)
        self.losses = torch.zeros(len(LOSSES), device=self.device)
        self.imitates = False
        self.imitation: ImitationLoss | None = None
        # 0 while only the critic learns, 1 afterwards.
        self._acting = torch.ones((), device=self.device)
        # Norms of the gradients of actor and critic, summed over an update: not finite if one was not. And the number
        # of mini-batches before the first such one.
        self.gradients = torch.zeros(2, device=self.device)
        self.before = torch.zeros(2, device=self.device)
        self._norms, self._good = torch.zeros_like(self.gradients), torch.zeros_like(self.before)
        # Sums over the mini-batches of an update, of all `LOSSES` but the learning rate.
        self._sums = torch.zeros(len(LOSSES) - 1, device=self.device)

    def act(self, obs: TensorDict) -> Tensor:
        """Sample the flat joint action `[N, sum]`."""
        step, memory = self.transition, self.memory
        if self.storage.step == 0:
            memory.begin()
        with self.precision():
            step.actions = self.actor(obs, None, memory.actor, stochastic_output=True)
            step.actions_log_prob = self.actor.get_output_log_prob(step.actions)
        step.values = self._values(obs)
        memory.step()
        step.distribution_params = self.actor.output_distribution_params
        step.observations = obs
        return step.actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]) -> None:
        """Store one step.

        Where an episode is cut off by the time limit, gamma * V(final state) is added to the reward.
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
        """Return the loss of a mini-batch; and value loss, surrogate loss, entropy and KL, detached `[4]`."""
        policy, measured = self.policy_loss(self.actor, batch)
        value = self.value_loss(batch)
        return policy + self.value_loss_coef * value, torch.cat([value.detach()[None], measured])

    def policy_loss(self, actor: MultiAgentActor, batch: RolloutStorage.Batch) -> tuple[Tensor, Tensor]:
        """Return the loss of the networks that act; and surrogate loss, entropy and KL, detached `[3]`."""
        actor.distribute(batch.observations, batch.masks, batch.hidden_states[0])
        log_prob = actor.get_output_log_prob(batch.actions)
        with torch.no_grad():
            params = actor.output_distribution_params
            divergence = actor.get_kl_divergence(batch.old_distribution_params, params).mean()
        entropy = actor.output_entropy.mean()
        ratio = torch.exp(log_prob - batch.old_actions_log_prob)
        surrogate = -self.surrogate(ratio, batch.advantages).mean()
        loss = surrogate - self.entropy_coef * entropy
        if self.imitation is not None:
            loss = loss + self.imitation(actor)
        return self._acting * loss, torch.stack([surrogate, entropy, divergence]).detach()

    def surrogate(self, ratio: Tensor, advantages: Tensor) -> Tensor:
        """Return the surrogate objective of each action, `[..., A]`: here the clipped one of PPO.

        Args:
            ratio: of the new probability to the old one, `[..., A]`.
            advantages: `[..., A]`.
        """
        clipped = ratio.clamp(1 - self.clip_param, 1 + self.clip_param)
        return torch.min(advantages * ratio, advantages * clipped)

    def value_loss(self, batch: RolloutStorage.Batch) -> Tensor:
        """Return the mean squared error of the critic, clipped if that was asked for, `[]`."""
        values = self.critic(batch.observations, batch.masks, batch.hidden_states[1])
        returns = self.scale.normalise(batch.returns)
        errors = (values - returns).square()
        if self.use_clipped_value_loss:
            old = self.scale.normalise(batch.values)
            near = old + (values - old).clamp(-self.clip_param, self.clip_param)
            errors = torch.max(errors, (near - returns).square())
        return errors.mean()

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute the returns and normalised advantages of the stored rollout.

        `obs` is the observation that comes after the rollout.
        """
        storage = self.storage
        storage.compute_returns(self._values(obs), self.gamma, self.lam)
        if "scale" in self.options:
            self.scale.learn(storage.returns.flatten(0, 1))
        advantages = storage.returns - storage.values
        if self.constraint is not None:
            self.constraint.update()
            advantages = self.constraint.weigh(advantages.unflatten(-1, (-1, 2)))
        storage.advantages.copy_(distributed.standardised(advantages))

    def hold_actor(self, held: bool, rate: float) -> None:
        """Let only the critic learn, or both again.

        The optimiser then begins anew for the actor. Its means of squared gradients would still be near zero, after all
        the gradients that were held, so that its first steps would be many times too long.

        Args:
            held: whether the networks that act stay as they are.
            rate: the learning rate from now on; while the actor is held nothing adapts it.
        """
        self._acting.fill_(not held)
        self._rate.fill_(rate)
        if not held:
            for weight in self.actor.parameters():
                for kept in self.optimizer.state[weight].values():
                    kept.zero_()

    def update(self) -> dict[str, float]:
        """Learn from the stored rollout; return mean losses, KL and the learning rate (see `LOSSES`)."""
        losses = dict(zip(LOSSES, self.learn().tolist(), strict=True))
        self.storage.clear()
        self.learning_rate = losses["learning_rate"]
        return losses

    def learn(self) -> Tensor:
        """Learn from the stored rollout without waiting for the device; return `losses`."""
        parts = self.parts()
        for index in self.order():
            parts[index]()
        return self.losses

    def parts(self) -> Sequence[Callable[[], None]]:
        """Return the functions that an update consists of.

        Each becomes a CUDA graph: it works in place, with shapes that are always the same, and doesn't wait for the
        device. Only `order` may change from update to update.
        """
        return [self._learn]

    def order(self) -> Sequence[int]:
        """Draw the order in which the next update calls its `parts`: the same in all processes."""
        return [0]

    def _learn(self) -> None:
        for batch in self.batches():
            with self.precision():
                loss, measured = self.loss(batch)
            self.descend(loss, measured[-1])
            self._sums += measured
        self.conclude()

    def batches(self) -> Iterator[RolloutStorage.Batch]:
        """Yield the mini-batches of the stored rollout, all of them in every epoch."""
        counts = (self.num_mini_batches, self.num_learning_epochs)
        if self.actor.is_recurrent:
            return self.storage.sequences(self.memory.begun, *counts)
        return self.storage.mini_batch_generator(*counts)

    def descend(self, loss: Tensor, divergence: Tensor) -> None:
        """Take a step of the optimiser down the gradient of a loss, with all processes.

        Args:
            loss: its gradient may be of some of the networks only; the others stay as they are.
            divergence: KL of the mini-batch, `[]`, which the learning rate adapts to.
        """
        self.optimizer.zero_grad()
        loss.backward()
        divergence = distributed.average_gradients(self.parameters(), divergence)
        if self.schedule == "adaptive":
            self._adapt_rate(divergence)
        models = (self.actor, self.critic)
        self._norms += torch.stack([clip_gradient(model, self.max_grad_norm) for model in models])
        self._good += self._norms.isfinite()
        self.optimizer.step()

    def conclude(self) -> None:
        """End an update: the normalisers learn from its observations, and `losses` are written."""
        observations = self.storage.observations.flatten(0, 1)
        if not self.imitates:
            self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        count = self.num_mini_batches * self.num_learning_epochs
        self.losses.copy_(torch.cat([self._sums / count, self._rate[None]]))
        self._sums.zero_()
        for kept, own in ((self.gradients, self._norms), (self.before, self._good)):
            kept.copy_(own)
            own.zero_()

    def parameters(self) -> list[nn.Parameter]:
        """Return all parameters that the optimiser changes."""
        return [*self.actor.parameters(), *self.critic.parameters()]

    def _values(self, obs: TensorDict) -> Tensor:
        """Return the values of observations, in units of reward."""
        with self.precision():
            return self.scale.restore(self.critic(obs, None, self.memory.critic))

    def precision(self) -> torch.autocast:
        """Return a context in which the networks compute in bfloat16, if that was asked for.

        It must be the same when acting and when learning. Otherwise the ratios would not begin at 1.
        """
        enabled = self.use_mixed_precision and self._cuda
        return torch.autocast("cuda" if self._cuda else "cpu", torch.bfloat16, enabled=enabled)

    def _adapt_rate(self, divergence: Tensor) -> None:
        """Adapt the learning rate as rsl_rl does: lower above twice the wanted divergence, higher below half of it."""
        low, high = LEARNING_RATE_RANGE
        slower = (self._rate / 1.5).clamp(min=low)
        faster = (self._rate * 1.5).clamp(max=high)
        rate = torch.where((divergence < self.desired_kl / 2) & (divergence > 0), faster, self._rate)
        self._rate.copy_(torch.where(divergence > self.desired_kl * 2, slower, rate))

    def save(self) -> dict[str, Any]:
        """Return all that `load` needs to go on, as tensors and plain values."""
        return {**super().save(), "options_state_dict": self.options.state_dict()}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None = None, strict: bool = True) -> bool:
        """Load what `save` returned.

        The optimizer then holds its own copy of the learning rate: share it again.
        """
        result = super().load(loaded_dict, load_cfg, strict)
        self.options.load_state_dict(loaded_dict.get("options_state_dict", {}))
        group = self.optimizer.param_groups[0]
        group["lr"] = self._rate = torch.as_tensor(group["lr"], device=self.device)
        group["capturable"] = self._cuda  # the checkpoint may come from another kind of device
        return result

    @classmethod
    def construct_algorithm(cls, obs: TensorDict, env: RslRlVecEnv, cfg: dict[str, Any], device: str) -> Self:
        """Build the algorithm from an rsl_rl configuration (see `rsl_rl_config`), as rsl_rl's runner does it.

        Raises:
            ValueError: the environment's agents are grouped otherwise than for this algorithm.
        """
        layout = env.layout
        if layout.grouping != cls.grouping:
            raise ValueError(
                f"{cls.__name__} learns with agents grouped by {cls.grouping!r}, not {layout.grouping!r}: "
                f"make the environment with grouping={cls.grouping!r}"
            )
        options, constraint = dict(cfg["algorithm"]), None
        if bounds := options.pop("constraint"):
            check_cost(bounds["cost"], env.env)
            constraint = Constraint(layout, env.num_envs, **bounds).to(device)
        per_agent = 1 if constraint is None else 2
        num_values = per_agent * layout.num_agents
        actor = make_actor(obs, env.env, layout, cfg["actor"])
        if cls.central_critic:
            critic: nn.Module = make_model(obs, ["state"], num_values, **cfg["critic"])
        else:
            critic = MultiAgentModel(obs, dict.fromkeys(layout.counts, per_agent), **cfg["critic"])
        for model in (actor, critic):
            share_normalisers(model)
        steps = cfg["num_steps_per_env"]
        sizes = (layout.num_agents, num_values, env.num_envs, steps)
        storage = MultiAgentStorage(*sizes, obs, env.num_actions, device)
        del options["class_name"]
        return cls(actor.to(device), critic.to(device), storage, constraint=constraint, device=device, **options)


def clip_gradient(model: nn.Module, most: float) -> Tensor:
    """Clip a model's gradient to a norm of at most `most`; return the norm before, `[]` on the model's device.

    It is 0 where a loss does not depend on the model. torch's own 0 would then be on the CPU.
    """
    weights = list(model.parameters())
    if all(weight.grad is None for weight in weights):
        return torch.zeros((), device=weights[0].device)
    return nn.utils.clip_grad_norm_(weights, most)
