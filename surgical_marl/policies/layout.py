"""How the dict of agents is stacked for networks that several agents share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from surgical_marl.envs.observations import proprioception

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


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


def _picture(observation: Mapping[str, Tensor]) -> Tensor:
    """Both pictures [..., H, W, 3] one behind the other, channels first: [..., 1, 6, H, W]."""
    return torch.cat([observation["image"], observation["target"]], -1).movedim(-1, -3).unsqueeze(-4).contiguous()
