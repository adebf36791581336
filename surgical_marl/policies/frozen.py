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
from surgical_marl.policies.acting import like, to_numpy
from surgical_marl.policies.target_mover import jaw_column

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.robots.jaw import Jaw


class Frozen:
    """Keep arms as they are when the policy begins to act: in a new episode, or in place of another one.

    An arm whose actions move position targets holds these, one under velocity or torque control is commanded 0. A jaw
    that is neither open nor closed stays within a control step's way of where it is commanded to be.

    Args:
        env: the environments.
        agents: the arms that keep still.
    """

    def __init__(self, env: BatchedEnv, agents: Sequence[str]) -> None:
        jaws = {agent: env.scene.mounts[agent].arm.jaw for agent in agents}
        self._env = env
        columns = {agent: jaw_column(env, agent) for agent in agents}
        self._jaws = {
            agent: None if jaw is None or (column := columns[agent]) is None else _StillJaw(env, agent, jaw, column)
            for agent, jaw in jaws.items()
        }
        self._next = np.full(env.num_envs, -1.0)
        """The number of the step in which the policy acts again, if no other one does before."""

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions {agent: [N, a]} of the arms."""
        steps, actions = to_numpy(self._env.steps), {}
        begins, self._next = steps != self._next, steps + 1
        for agent, jaw in self._jaws.items():
            seen = proprioception(observations[agent])
            action = np.zeros((len(seen), *self._env.action_space(agent).shape))
            if jaw is not None:
                action[:, jaw.column] = jaw.action(begins)
            actions[agent] = like(seen, action)
        return actions

    def reset(self, ended: np.ndarray | None = None) -> None:
        """Begin anew when the policy is next asked: in all environments, or where an episode has `ended`, [N] bool."""
        self._next[slice(None) if ended is None else to_numpy(ended).astype(bool)] = -1


class _StillJaw:
    """The jaw of an arm that keeps still."""

    def __init__(self, env: BatchedEnv, agent: str, jaw: Jaw, column: int) -> None:
        arm = env.scene.mounts[agent].arm
        self._env, self._ends = env, np.array([[jaw.open], [jaw.closed]])
        self.column = column
        self._reach = env.control_dt * arm.speed[arm.moves_jaw][0]
        self._actuator = env.scene.model.actuator(f"{agent}/{jaw.joint}").id
        self._kept = np.zeros(env.num_envs)

    def action(self, begins: np.ndarray) -> np.ndarray:
        """Return 1 where opening, and 0 where closing, leads nearer to the command that is kept, [N].

        It is the present command in the environments where the policy `begins`, [N] bool.
        """
        command = to_numpy(self._env.engine.read(".physics.arms.ctrl", "numpy"))[:, self._actuator]
        self._kept = np.where(begins, command, self._kept)
        opened, closed = np.abs(command + np.clip(self._ends - command, -self._reach, self._reach) - self._kept)
        return np.where(opened < closed, 1.0, 0.0)
