"""The TorchRL face: agents of a kind are a group, and tensors stay where the environments are.

    batch = BatchedEnv("reach", "trimanual_psm_ecm", num_envs=1024, arrays="torch", observations="scaled")
    env = TorchRLEnv(batch)
    env.rollout(100, break_when_any_done=False)["psm", "observation"]      # [1024, 100, 2, 34]

As in TorchRL's own environments with many agents, what a group has lies under the group's name, and what all share at
the root. torchrl is no dependency of this package: `pip install torchrl`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.state import BatchStep

try:
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase, MarlGroupMapType, check_marl_grouping
except ImportError as error:
    raise ImportError(f"the TorchRL face needs torchrl, as from `pip install torchrl` ({error})") from None


class TorchRLEnv(EnvBase):
    """A `BatchedEnv` (made with `arrays="torch"`) as a `torchrl.envs.EnvBase` of batch size [N].

    With n agents in a group of width d:
    `(group, "observation")` [N, n, d], or for agents that see pictures nested ones `(group, "observation", name)`;
    `(group, "action")` [N, n, a] in [-1, 1]; `(group, "reward")` [N, n, 1]; `(group, "info", name)` [N, n].
    At the root: "state" [N, S], "done", "terminated" and "truncated" [N, 1], which all agents share.

    "next" holds the last observations of an episode that ends. Environments start anew within the step, so that a
    reset of those that have ended costs nothing; others can be reset only all together.

    Args:
        env: the environments.
        group_map: group -> agents, or one of TorchRL's `MarlGroupMapType`; the agents of each kind if None. The agents
            of a group must have the same spaces.

    Raises:
        ValueError: arrays of another library, a group of different agents, or agents in no group or several.
    """

    def __init__(self, env: BatchedEnv, group_map: Mapping[str, list[str]] | MarlGroupMapType | None = None) -> None:
        if env.arrays != "torch":
            raise ValueError(f"TorchRL needs a BatchedEnv with arrays='torch', not arrays={env.arrays!r}")
        super().__init__(device=torch.device(env.device), batch_size=[env.num_envs])
        self.env = env
        if isinstance(group_map, MarlGroupMapType):
            group_map = group_map.get_group_map(env.agents)
        self.group_map = {name: list(agents) for name, agents in (group_map or env.types).items()}
        check_marl_grouping(self.group_map, env.agents)
        for name, (first, *others) in self.group_map.items():
            for agent in others:
                if env.observation_space(agent) != env.observation_space(first):
                    raise ValueError(f"group {name!r} can't hold {first!r} and {agent!r}: they observe unlike things")
        self._seed: int | None = None
        self._fresh: TensorDict | None = None
        self._ended = torch.zeros(env.num_envs, dtype=torch.bool, device=self.device)
        self._make_specs()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the memory and the threads of the environments."""
        super().close(raise_if_closed=raise_if_closed)
        self.env.close()

    def _make_specs(self) -> None:
        count, device = self.env.num_envs, self.device
        infos = self.env.reset(0)[2]
        observed, acted, rewarded = {"state": _spec(self.env.state_space, (count,), device)}, {}, {}
        for name, agents in self.group_map.items():
            shape, first = (count, len(agents)), agents[0]
            info = {key: _like(value, shape) for key, value in infos[first].items()}
            group = {
                "observation": _spec(self.env.observation_space(first), shape, device),
                "info": Composite(info, shape=shape, device=device),
            }
            observed[name] = Composite(group, shape=shape, device=device)
            action = _spec(self.env.action_space(first), shape, device)
            acted[name] = Composite({"action": action}, shape=shape, device=device)
            reward = Unbounded((*shape, 1), device=device)
            rewarded[name] = Composite({"reward": reward}, shape=shape, device=device)
        self.observation_spec = Composite(observed, shape=(count,), device=device)
        self.action_spec = Composite(acted, shape=(count,), device=device)
        self.reward_spec = Composite(rewarded, shape=(count,), device=device)
        ends = ("done", "terminated", "truncated")
        flags = {name: Binary(1, (count, 1), dtype=torch.bool, device=device) for name in ends}
        self.done_spec = Composite(flags, shape=(count,), device=device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        if self._fresh is not None and chosen is not None and self._seed is None:
            going = chosen.reshape(-1) & ~self._ended
            if not going.any():
                return self._fresh.copy()
            if not chosen.all():
                raise ValueError(
                    f"{int(going.sum())} environments are within an episode: reset all, or those that ended"
                )
        observations, state, infos = self.env.reset(self._seed)
        self._seed = None
        self._ended = torch.zeros_like(self._ended)
        self._fresh = self._group(observations, state, infos)
        return self._fresh.copy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = {
            agent: action
            for name, agents in self.group_map.items()
            for agent, action in zip(agents, tensordict[name, "action"].unbind(-2), strict=True)
        }
        step: BatchStep = self.env.step(actions)
        self._ended = step.terminated | step.truncated
        self._fresh = self._group(step.observations, step.state, step.infos)
        found = self._group(step.final_observations, step.final_state, step.infos)
        for name, agents in self.group_map.items():
            found[name, "reward"] = _stack([step.rewards[agent] for agent in agents], 1).unsqueeze(-1)
        for name, flag in (("done", self._ended), ("terminated", step.terminated), ("truncated", step.truncated)):
            found[name] = flag.unsqueeze(-1)
        return found

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def _group(self, observations: Mapping[str, Any], state: Tensor, infos: Mapping[str, Any]) -> TensorDict:
        """Return the observations and infos of the agents of each group, stacked."""
        count = self.env.num_envs
        found = TensorDict({"state": state}, batch_size=[count], device=self.device)
        for name, agents in self.group_map.items():
            group = {
                "observation": self._beside([observations[agent] for agent in agents]),
                "info": self._beside([infos[agent] for agent in agents]),
            }
            found[name] = TensorDict(group, batch_size=[count, len(agents)], device=self.device)
        return found

    def _beside(self, parts: list[Any]) -> Any:
        if not isinstance(parts[0], dict):
            return _stack(parts, 1)
        each = {name: _stack([part[name] for part in parts], 1) for name in parts[0]}
        return TensorDict(each, batch_size=[self.env.num_envs, len(parts)], device=self.device)


def _stack(parts: list[Tensor], dimension: int) -> Tensor:
    """Return tensors beside each other; one alone is not copied."""
    return parts[0].unsqueeze(dimension) if len(parts) == 1 else torch.stack(parts, dimension)


def _spec(space: spaces.Space[Any], batch: tuple[int, ...], device: Any) -> Any:
    """Return the spec of a space of one environment or agent, for a batch of them."""
    if isinstance(space, spaces.Dict):
        own = {name: _spec(part, batch, device) for name, part in space.items()}
        return Composite(own, shape=batch, device=device)
    shape = (*batch, *space.shape)  # type: ignore[misc]
    dtype = torch.from_numpy(np.zeros(1, space.dtype)).dtype
    low, high = (torch.from_numpy(getattr(space, end)).to(device).expand(shape) for end in ("low", "high"))
    if not (low.float().isfinite().all() and high.float().isfinite().all()):
        return Unbounded(shape, device=device, dtype=dtype)
    return Bounded(low, high, shape, device=device, dtype=dtype)


def _like(value: Tensor, shape: tuple[int, ...]) -> Any:
    if value.dtype == torch.bool:
        return Binary(shape[-1], shape, dtype=torch.bool, device=value.device)
    return Unbounded(shape, device=value.device, dtype=value.dtype)
