"""The environment as rsl_rl sees it: agents stacked by type, one flat joint action.

`Layout` says how the dict of agents is stacked; `RslRlVecEnv` applies it to a `BatchedEnv`. A
trained policy uses the same `Layout`, so that training and evaluation cannot disagree.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from surgical_marl.observations import proprioception

if TYPE_CHECKING:
    from surgical_marl.batch import BatchedEnv


class Layout:
    """How the agents of an environment are stacked into groups.

    Each agent type is a group `[..., n, d]`; where a type has several agents, each sees a one-hot
    of its place among them, since they share one network. With `joint=True` there is one group,
    "joint", of one agent that observes and moves all arms.

    Attributes:
        agents: every arm, in the order of groups; this is the order of the flat joint action.
        counts: agents acting in each group.
        action_sizes: width of the action of one agent of each group.
    """

    def __init__(self, env: BatchedEnv, *, joint: bool = False) -> None:
        self.joint = joint
        self.types = {name: list(members) for name, members in env.types.items()}
        self.agents = [agent for members in self.types.values() for agent in members]
        self._widths = [int(np.prod(env.action_space(agent).shape)) for agent in self.agents]
        if joint:
            self.counts = {"joint": 1}
            self.action_sizes = {"joint": sum(self._widths)}
        else:
            width = dict(zip(self.agents, self._widths, strict=True))
            self.counts = {name: len(members) for name, members in self.types.items()}
            self.action_sizes = {name: width[members[0]] for name, members in self.types.items()}

    @property
    def num_agents(self) -> int:
        """Number of acting agents, A: the width of rewards and values."""
        return sum(self.counts.values())

    @property
    def num_actions(self) -> int:
        """Width of the flat joint action."""
        return sum(self._widths)

    def stack(self, observations: Mapping[str, Any]) -> dict[str, Tensor]:
        """Observations of agents `[..., d]` -> groups `[..., n, d]`, and of an agent that sees pictures also a group
        "<name>_pictures" `[..., 1, 6, H, W]` uint8: what it sees, and what it should see.

        Always a copy: an engine may reuse its buffers.
        """
        groups = {}
        for name, members in ({"joint": self.agents} if self.joint else self.types).items():
            felt = [proprioception(observations[agent]) for agent in members]
            groups[name] = torch.cat(felt, -1).unsqueeze(-2) if self.joint else self._stack_type(felt)
            for agent in members:
                if isinstance(observations[agent], Mapping):
                    groups[f"{name}_pictures"] = _picture(observations[agent])
        return groups

    @staticmethod
    def _stack_type(members: list[Tensor]) -> Tensor:
        stacked = torch.stack(members, -2)
        count = len(members)
        if count == 1:
            return stacked
        identity = torch.eye(count, dtype=stacked.dtype, device=stacked.device)
        return torch.cat([stacked, identity.expand(*stacked.shape[:-1], count)], -1)

    def split(self, actions: Tensor) -> dict[str, Tensor]:
        """Flat joint action `[..., sum]` -> action of each arm `[..., a]`."""
        return dict(zip(self.agents, actions.split(self._widths, -1), strict=True))

    def rewards(self, rewards: Mapping[str, Tensor]) -> Tensor:
        """Rewards of arms `[N]` -> of acting agents `[N, A]`; a joint agent gets the sum."""
        stacked = torch.stack([rewards[agent] for agent in self.agents], -1)
        return stacked.sum(-1, keepdim=True) if self.joint else stacked


class RslRlVecEnv(VecEnv):
    """A `BatchedEnv` (made with `arrays="torch"`) as an `rsl_rl.env.VecEnv`.

    Observations are a TensorDict of batch size [N]: one group `[N, n, d]` for each agent type (see
    `Layout`) and "state" `[N, S]`. The environment is reset once, here; `get_observations` neither
    resets nor steps.

    Attributes:
        reward_terms: names of the weighted terms in the infos that the rewards are the sum of.
    """

    def __init__(self, env: BatchedEnv, *, joint: bool = False, seed: int | None = None, first: int = 0) -> None:
        self.env = env
        self.layout = Layout(env, joint=joint)
        self.num_envs = env.num_envs
        self.num_actions = self.layout.num_actions
        self.max_episode_length = env.max_steps
        self.device = env.device
        self.cfg: dict[str, Any] = {}
        observations, state, infos = env.reset(seed, first)
        self.reward_terms = sorted({name for info in infos.values() for name in info if name.startswith("reward_")})
        self._observations = self._group(observations, state)

    @property
    def capturable(self) -> bool:
        """Whether a CUDA graph can hold `step`."""
        return bool(self.env.device == "cuda" and self.env.engine.name == "fused")

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps since reset, `[N]`. Set it to let episodes end at different times."""
        return torch.as_tensor(self.env.steps)

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        self.env.steps = steps.cpu().numpy()

    def get_observations(self) -> TensorDict:
        """The observations that the next action answers."""
        return self._observations

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step of all environments.

        Args:
            actions: `[N, sum]`, clipped to [-1, 1], in the order of `layout.agents`.

        Returns:
            Observations after auto-reset; the mean reward over agents `[N]`; done flags `[N]`
            (bool); and extras: "agent_rewards" `[N, A]`, "time_outs" `[N]` (bool, truncated and not
            terminated), "final_obs" (the observations of the finished step, before auto-reset) and
            "infos" of the environment.
        """
        step = self.env.step(self.layout.split(actions.clamp(-1.0, 1.0)))
        self._observations = self._group(step.observations, step.state)
        rewards = self.layout.rewards(step.rewards)
        extras = {
            "agent_rewards": rewards,
            "time_outs": step.truncated & ~step.terminated,
            "final_obs": self._group(step.final_observations, step.final_state),
            "infos": step.infos,
        }
        return self._observations, rewards.mean(-1), step.terminated | step.truncated, extras

    def carry(self) -> dict[str, dict[str, Tensor]]:
        """What `set_carry` needs to continue bit for bit, as plain dicts of tensors."""
        env = {name: _tensor(value) for name, value in self.env.carry().items()}
        return {"env": env, "observations": self._observations.to_dict()}

    def set_carry(self, carry: Mapping[str, Mapping[str, Tensor]]) -> None:
        """Continue from what `carry` returned."""
        self.env.set_carry({name: value.numpy() for name, value in carry["env"].items()})
        groups = {name: value.to(self.device) for name, value in carry["observations"].items()}
        self._observations = TensorDict(groups, batch_size=[self.num_envs])

    def _group(self, observations: Mapping[str, Any], state: Any) -> TensorDict:
        groups = {**self.layout.stack(observations), "state": state.clone()}
        return TensorDict(groups, batch_size=[self.num_envs])


def _picture(observation: Mapping[str, Tensor]) -> Tensor:
    """Both pictures [..., H, W, 3] one behind the other, channels first: [..., 1, 6, H, W]."""
    return torch.cat([observation["image"], observation["target"]], -1).movedim(-1, -3).unsqueeze(-4).contiguous()


def _tensor(value: Any) -> Tensor:
    return value if isinstance(value, Tensor) else torch.from_numpy(np.array(value))
