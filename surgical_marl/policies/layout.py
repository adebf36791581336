"""Stacks the agents' arrays for networks that several agents share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from surgical_marl.envs.observations import proprioception

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


FURTHEST = 0.3
"""Depth is clipped to this for networks, m; endoscopes are nearer to what they look at."""
Grouping = Literal["type", "agent", "joint"]
GROUPINGS: tuple[Grouping, ...] = ("type", "agent", "joint")


class Layout:
    """The grouping of an environment's agents: one network for each group.

    By "type", agents of an arm type are one group `[..., n, d]`; if a type has several agents, the observation of each
    ends with a one-hot of its position among them, because they share one network. By "agent", each agent is a group of
    its own. "joint" is one group of one agent, which observes and moves all arms.

    Args:
        env: the environment of the agents.
        grouping: "type", "agent" or "joint".

    Attributes:
        agents: every arm, type by type, in the order of the flat joint action.
        groups: the arms of each group.
        counts: agents acting in each group.
        action_sizes: width of the action of one agent of each group.
        messages: numbers at the end of an agent's action that its teammates hear; 0 for one joint agent.
        pictures: of each group name -> space of the pictures that one agent sees, in the order of the stack.
    """

    def __init__(self, env: BatchedEnv, grouping: Grouping = "type") -> None:
        self.grouping = grouping
        types = {name: list(members) for name, members in env.types.items()}
        self.agents = [agent for members in types.values() for agent in members]
        widths = {agent: int(np.prod(env.action_space(agent).shape)) for agent in self.agents}
        self._widths = list(widths.values())
        self.messages = 0 if grouping == "joint" else env.env.options.messages
        if grouping == "joint":
            self.groups = {"joint": self.agents}
            self.counts = {"joint": 1}
            self.action_sizes = {"joint": sum(self._widths)}
        else:
            self.groups = types if grouping == "type" else {agent: [agent] for agent in self.agents}
            self.counts = {name: len(members) for name, members in self.groups.items()}
            self.action_sizes = {name: widths[members[0]] for name, members in self.groups.items()}

        one_of_each = self.groups if grouping == "joint" else {name: each[:1] for name, each in self.groups.items()}
        self.pictures = {name: _seen(env, members) for name, members in one_of_each.items()}

    @property
    def num_agents(self) -> int:
        """Number of acting agents, A: the width of rewards and values."""
        return sum(self.counts.values())

    @property
    def num_actions(self) -> int:
        """Width of the flat joint action."""
        return sum(self._widths)

    def stack(self, observations: Mapping[str, Any]) -> dict[str, Tensor]:
        """Stack the observations of agents `[..., d]` into groups `[..., n, d]`.

        If agents of a group see pictures, there is also a group "<name>_pictures" `[..., n, C, H, W]`. It holds all
        pictures of an agent, stacked along channels.

        The result is always a copy, because an engine may reuse its buffers.
        """
        groups = {}
        for name, members in self.groups.items():
            felt = [proprioception(observations[agent]) for agent in members]
            groups[name] = torch.cat(felt, -1).unsqueeze(-2) if self.grouping == "joint" else self._stack_group(felt)
            seen = [
                stack_pictures([observations[agent][term] for term in _terms(observations[agent])])
                for agent in members
                if isinstance(observations[agent], Mapping)
            ]
            if seen:
                pictures = torch.cat(seen, -3).unsqueeze(-4) if self.grouping == "joint" else torch.stack(seen, -4)
                groups[f"{name}_pictures"] = pictures.contiguous()
        return groups

    @staticmethod
    def _stack_group(members: list[Tensor]) -> Tensor:
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
        return stacked.sum(-1, keepdim=True) if self.grouping == "joint" else stacked


def _terms(observation: Mapping[str, Any]) -> list[str]:
    """Return the names of an agent's pictures, sorted by name: spaces sort them so, and observations do not."""
    return sorted(name for name in observation if name != "proprioception")


def _seen(env: BatchedEnv, agents: Sequence[str]) -> dict[str, Any]:
    """Return the spaces of the pictures of some agents, by the names of the pictures.

    If several agents see pictures, the names are "<agent>/<name>".
    """
    spaces = {agent: getattr(env.observation_space(agent), "spaces", {}) for agent in agents}
    several = sum(map(bool, spaces.values())) > 1
    return {f"{agent}/{term}" if several else term: own[term] for agent, own in spaces.items() for term in _terms(own)}


def stack_pictures(parts: Sequence[Tensor]) -> Tensor:
    """Stack pictures [..., H, W, c] along channels, channels first: [..., C, H, W].

    Colours stay uint8. If there is depth, it is scaled to 0 to 255 at `FURTHEST`, and all pictures become float32.
    """
    scaled = [part if part.dtype == torch.uint8 else part.clamp(max=FURTHEST) * (255 / FURTHEST) for part in parts]
    alike = scaled if len({part.dtype for part in scaled}) == 1 else [part.float() for part in scaled]
    return torch.cat(alike, -1).movedim(-1, -3)
