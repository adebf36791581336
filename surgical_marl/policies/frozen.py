"""The policy of arms that keep still, their jaws too.

    still = Frozen(env, ["psm_1"])
    actions = still(observations)              # of psm_1

An action of 0 leaves the command of every joint where it is, but closes a jaw, which knows only open and closed. So a
jaw needs actions that keep its command where it was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from surgical_marl.envs.observations import proprioception
from surgical_marl.policies.convert import like, to_numpy

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


class Frozen:
    """Keep arms as they are when an episode begins, or when the policy is first asked in it.

    An arm under position control holds its targets, one under velocity or torque control is commanded 0. A jaw that is
    neither open nor closed stays within a control step's way of where it is commanded to be.

    Args:
        env: the environments.
        agents: the arms that keep still.
    """

    def __init__(self, env: BatchedEnv, agents: Sequence[str]) -> None:
        self._env = env
        self._jaws = {agent: _Jaw(env, agent) if env.scene.mounts[agent].arm.jaw else None for agent in agents}
        self._due = np.ones(env.num_envs, bool)
        """Where jaws are to stay as they are now."""

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions {agent: [N, a]} of the arms."""
        actions = {}
        due = self._due | (to_numpy(self._env.steps) == 0)
        for agent, jaw in self._jaws.items():
            seen = proprioception(observations[agent])
            action = np.zeros((len(seen), *self._env.action_space(agent).shape))
            if jaw is not None:
                action[:, jaw.column] = jaw.action(due)
            actions[agent] = like(seen, action)
        self._due = np.zeros(self._env.num_envs, bool)
        return actions

    def reset(self, ended: np.ndarray | None = None) -> None:
        """Keep arms as they will be when the policy is next asked: in all environments, or where `ended`, [N] bool."""
        self._due |= True if ended is None else to_numpy(ended).astype(bool)


class _Jaw:
    """The jaw of an arm that keeps still."""

    def __init__(self, env: BatchedEnv, agent: str) -> None:
        arm = env.scene.mounts[agent].arm
        self._env, self._jaw = env, arm.jaw
        self.column = int(np.flatnonzero(arm.moves_jaw)[0])
        self._reach = env.control_dt * arm.speed[self.column]
        self._actuator = env.scene.model.actuator(f"{agent}/{arm.jaw.joint}").id
        self._kept = np.zeros(env.num_envs)

    def action(self, due: np.ndarray) -> np.ndarray:
        """Return 1 where opening, and 0 where closing, leads nearer to the command that is kept, [N].

        It is the present command in the environments `due`, [N] bool.
        """
        command = to_numpy(self._env.engine.read(".physics.ctrl", "numpy"))[:, self._actuator]
        self._kept = np.where(due, command, self._kept)
        ends = np.array([self._jaw.open, self._jaw.closed])[:, None]
        opened, closed = np.abs(command + np.clip(ends - command, -self._reach, self._reach) - self._kept)
        return np.where(opened < closed, 1.0, 0.0)
