"""A tiny environment with the interface of `BatchedEnv`: each arm is a point with a goal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from torch import Tensor

from surgical_marl.plugins.tasks import TASKS
from surgical_marl.tasks.base.options import Options


class Point:
    """An arm whose joints are its tip's coordinates."""

    remote_center = jaw = None

    def forward_kinematics(self, q: np.ndarray) -> np.ndarray:
        pose = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4)).copy()
        pose[..., : q.shape[-1], 3] = q
        return pose


class FakeEnv:
    """Points in as many dimensions as `sizes` says for each type; actions are velocities."""

    def __init__(self, counts: dict[str, int], sizes: dict[str, int], num_envs: int = 64, max_steps: int = 20) -> None:
        self.types = {name: [f"{name}_{i}" for i in range(count)] for name, count in counts.items()}
        self.agents = [agent for members in self.types.values() for agent in members]
        self.sizes = {a: sizes[name] for name, members in self.types.items() for a in members}
        self.arrays = "torch"
        self.num_envs, self.max_steps, self.control_dt, self.device = (
            num_envs,
            max_steps,
            0.05,
            "cpu",
        )
        mounts = dict.fromkeys(self.agents, SimpleNamespace(arm=Point()))
        ends = np.cumsum(list(self.sizes.values()))
        joints = {a: np.arange(end - self.sizes[a], end) for a, end in zip(self.agents, ends, strict=True)}
        self.task_name, self.control, self.env = "reach", "position", SimpleNamespace(options=Options("reach", "psm"))
        self.task = TASKS.load("reach").__new__(TASKS.load("reach"))  # its functions of a goal need no scene
        self.scene = SimpleNamespace(name="fake", mounts=mounts, qpos_index=joints.__getitem__)
        self.state_space = self._box(2 * sum(self.sizes.values()))
        self.generator = torch.Generator()
        self.line = 1.2  # an arm collides beyond it
        self.poison = False  # return NaN observations
        self.terminate = False  # end episodes by termination as well
        self.autoreset = True

    @staticmethod
    def _box(size: int, limit: float = float("inf")) -> Box:
        return Box(-limit, limit, (size,))

    def observation_space(self, agent: str) -> Box:
        return self._box(2 * self.sizes[agent])

    def action_space(self, agent: str) -> Box:
        return self._box(self.sizes[agent], 1.0)

    def action_terms(self, agent: str) -> dict[str, slice]:
        return {"velocity": slice(0, self.sizes[agent])}

    def _draw(self) -> dict[str, Tensor]:
        shapes = {agent: (self.num_envs, 2 * size) for agent, size in self.sizes.items()}
        return {a: torch.rand(s, generator=self.generator) * 2 - 1 for a, s in shapes.items()}

    def reset(
        self, seed: int | None = None, first: int = 0, mask: np.ndarray | None = None
    ) -> tuple[dict[str, Tensor], Tensor, dict[str, Any]]:
        assert mask is None or mask.all()  # its environments all end at once
        if seed is not None:
            self.generator.manual_seed(seed + 1000 * first)
        self.where = self._draw()
        self.steps = np.zeros(self.num_envs, np.int64)
        return *self._observe(), {agent: self._info(agent) for agent in self.agents}

    def _observe(self) -> tuple[dict[str, Tensor], Tensor]:
        observations = {agent: where.clone() for agent, where in self.where.items()}
        if self.poison:
            observations[self.agents[0]][0, 0] = float("nan")
        return observations, torch.cat(list(observations.values()), -1)

    def step(self, actions: dict[str, Tensor]) -> Any:
        infos, rewards = {}, {}
        for agent, size in self.sizes.items():
            assert actions[agent].shape == (self.num_envs, size) and not (actions[agent].abs() > 1).any()
            self.where[agent] = self.where[agent].clone()
            self.where[agent][:, :size] += 0.2 * actions[agent]
            infos[agent] = self._info(agent)
            rewards[agent] = -infos[agent]["tip_error"]
        final_observations, final_state = self._observe()
        self.steps = self.steps + 1
        truncated = torch.from_numpy(self.steps >= self.max_steps)
        if self.autoreset:
            fresh = self._draw()
            self.where = {a: torch.where(truncated[:, None], fresh[a], w) for a, w in self.where.items()}
            self.steps = np.where(truncated, 0, self.steps)
        observations, state = self._observe()
        return SimpleNamespace(
            observations=observations,
            state=state,
            rewards=rewards,
            terminated=truncated & self.terminate,
            truncated=truncated,
            final_observations=final_observations,
            final_state=final_state,
            infos=infos,
            faults=torch.full((self.num_envs,), -1, dtype=torch.int32),
        )

    def _info(self, agent: str) -> dict[str, Tensor]:
        size, where = self.sizes[agent], self.where[agent]
        error = (where[:, :size] - where[:, size:]).norm(dim=-1)
        return {
            "tip_error": error,
            "success": error < 0.1,
            "collision": where[:, 0] > self.line,
            "min_distance": self.line - where[:, 0],
            # a term that the last agent lacks, as a camera's
            "reward_distance": -error if agent == self.agents[-1] else -0.75 * error,
            **({} if agent == self.agents[-1] else {"reward_late": -0.25 * error}),
        }

    @property
    def goal(self) -> SimpleNamespace:
        """Where the arms should be, [N, sum of coordinates]."""
        return SimpleNamespace(
            targets=np.concatenate([self.where[a][:, n:].numpy() for a, n in self.sizes.items()], -1)
        )

    @property
    def qpos(self) -> np.ndarray:
        return np.concatenate([self.where[a][:, :size].numpy() for a, size in self.sizes.items()], -1)

    def carry(self) -> dict[str, np.ndarray]:
        state = {"steps": self.steps.copy(), "generator": self.generator.get_state().numpy()}
        state |= {f"where/{agent}": where.numpy() for agent, where in self.where.items()}
        return state

    def carry_tensors(self) -> dict[str, Tensor]:
        return {f"where/{agent}": where.clone() for agent, where in self.where.items()}

    def set_carry(self, carry: dict[str, np.ndarray]) -> None:
        self.steps = carry["steps"].copy()
        self.generator.set_state(torch.tensor(carry["generator"]))
        self.where = {agent: torch.tensor(carry[f"where/{agent}"]) for agent in self.agents}
