"""Stacks the agents' arrays, of numpy or torch, for networks that several agents share."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from surgical_marl.envs.observations import proprioception

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

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

    def widths(self, env: BatchedEnv) -> dict[str, list[int]]:
        """Return of each group how many agents act, and the widths of an agent's observation and of its action."""
        seen = self.stack({agent: proprioception(zeros(env.observation_space(agent))) for agent in self.agents})
        return {name: [count, seen[name].shape[-1], self.action_sizes[name]] for name, count in self.counts.items()}

    def stack(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Stack the observations of agents `[..., d]` into groups `[..., n, d]`.

        If agents of a group see pictures, there is also a group "<name>_pictures" `[..., n, C, H, W]`. It holds all
        pictures of an agent, stacked along channels.

        The result is always a copy, because an engine may reuse its buffers.
        """
        groups, joint = {}, self.grouping == "joint"
        for name, members in self.groups.items():
            felt = [proprioception(observations[agent]) for agent in members]
            groups[name] = _library(felt[0]).concatenate(felt, -1)[..., None, :] if joint else self._stack_group(felt)
            seen = [
                [observations[agent][term] for term in _terms(observations[agent])]
                for agent in members
                if isinstance(observations[agent], Mapping)
            ]
            if seen:
                from surgical_marl.policies.encoder import stack_pictures

                groups[f"{name}_pictures"] = stack_pictures(seen, joint)
        return groups

    @staticmethod
    def _stack_group(members: list[Any]) -> Any:
        library, count = _library(members[0]), len(members)
        stacked = library.stack(members, -2)
        if count == 1:
            return stacked
        identity = library.eye(count, dtype=stacked.dtype, device=stacked.device)
        return library.concatenate([stacked, library.broadcast_to(identity, (*stacked.shape[:-1], count))], -1)

    def split(self, actions: Any) -> dict[str, Any]:
        """Split a flat joint action `[..., sum]` into the action of each arm, `[..., a]`."""
        spans = zip(self.agents, np.cumsum(self._widths).tolist(), self._widths, strict=True)
        return {agent: actions[..., end - width : end] for agent, end, width in spans}

    def rewards(self, rewards: Mapping[str, Any]) -> Any:
        """Return the rewards of acting agents `[N, A]` from those of arms, `[N]`; a joint agent gets the sum."""
        each = [rewards[agent] for agent in self.agents]
        stacked = _library(each[0]).stack(each, -1)
        return stacked.sum(-1)[..., None] if self.grouping == "joint" else stacked


def fitting_layout(env: BatchedEnv, trained: Mapping[str, list[int]], run: object, scene: str) -> Layout:
    """Return the layout of an environment whose groups are those that a policy was trained with.

    Args:
        env: the environment that the policy will act in.
        trained: what `Layout.widths` said of the environment of the training.
        run, scene: for the error: where the policy is, and where it was trained.

    Raises:
        ValueError: it was trained on other agents.
    """
    layouts = {layout: layout.widths(env) for layout in (Layout(env, grouping) for grouping in GROUPINGS)}
    nearest = max(layouts, key=lambda layout: (layouts[layout] == trained, len(layout.groups.keys() & trained)))
    if layouts[nearest] != trained:
        raise ValueError(
            f"the policy in {run} was trained in scene {scene!r}, whose agents ({_describe(trained)}) are not those "
            f"of this environment ({_describe(layouts[nearest])})"
        )
    return nearest


def zeros(space: Any) -> Any:
    """Return one observation, of a Box or of a Dict with pictures."""
    if hasattr(space, "spaces"):
        return {name: zeros(part) for name, part in space.spaces.items()}
    return np.zeros((1, *space.shape), space.dtype)


def _describe(groups: Mapping[str, list[int]]) -> str:
    return ", ".join(f"{n} {name} of {d} observations and {a} actions" for name, (n, d, a) in groups.items())


def _library(array: Any) -> Any:
    """Return the library of an array, numpy or torch, which whoever made the array has imported."""
    return sys.modules[type(array).__module__.partition(".")[0]]


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
