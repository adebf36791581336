"""The oracle, a scripted policy that knows the goals: inverse kinematics of the targets, at the joints' speeds.

    policy = oracle(env)            # the same as load_policy("oracle", env)
    actions = policy(observations)

Its results show what is possible: a goal that it can't reach may be impossible. It needs no learning, but reads the
environment's goals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from surgical_marl.envs.observations import proprioception
from surgical_marl.plugins.task_file import label
from surgical_marl.policies.acting import like, to_numpy
from surgical_marl.policies.scripted import Scripted
from surgical_marl.policies.target_mover import TargetMover, check_control
from surgical_marl.robots.inverse_kinematics import inverse_kinematics

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

ITERATIONS = 8
"""Steps of inverse kinematics from the last joint positions."""
NEAR, AHEAD = 4, 2
"""Steps of inverse kinematics to a moving target, which is never far, and to its place a control step later."""
CATCH_UP = 0.025
"""Time in which a tip that is off a moving target comes three times as near to it, s: hardly more than a control step.
With a position command alone it would take damping over stiffness of the drives, four times as long for a STAR."""
FIRST, STARTS = 20, 8
"""Steps at the start of an episode, and postures that they start from: from one alone they may end at a limit."""


class Oracle(Protocol):
    """A policy, and where it waits."""

    waits: np.ndarray
    """True if its tools wait for time to pass in an environment, [N] bool."""

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        """Return the actions of agents."""
        ...


def oracle(env: BatchedEnv, agents: Sequence[str] | None = None) -> Oracle:
    """Make the oracle of an environment with position targets, for all of its tasks.

    If the task has a script, the arms follow it. Otherwise joints follow straight lines in joint space, all arms at the
    same pace; `tasks/base/workspace.py` has checked these paths. For moving targets, commands lead by the joints' lag:
    a control step, plus damping over stiffness of their drives; and what a tip is off makes up for itself in
    `CATCH_UP`.

    Args:
        agents: the agents that the oracle moves, if others have another policy. Only these are kept at the same pace.

    Returns:
        A policy: observations {agent: [N, d]} of `env` as it stands -> actions {agent: [N, a]} of the same library, of
        the agents that it moves. It says nothing: its messages are zeros.

    Raises:
        ValueError: the environment's control has no position targets.
    """
    check_control(env.control)
    steps = env.task.script()
    if not env.task.has_targets and not steps:
        raise ValueError(f"the task {label(env.task_name)!r} has no target for tool tips that an oracle could move to")
    agents = env.agents if agents is None else agents
    return Scripted(env, steps, agents) if steps else _Oracle(env, agents)


class _Oracle:
    """The policy of `oracle`."""

    def __init__(self, env: BatchedEnv, moved: Sequence[str]) -> None:
        self._env = env
        self.waits = np.zeros(env.num_envs, bool)
        self._arms = {agent: _Guide(env, agent, index) for index, agent in enumerate(env.agents) if agent in moved}

    def __call__(self, observations: Mapping[str, Any]) -> dict[str, Any]:
        env, arms = self._env, self._arms
        targets, began = np.asarray(env.task.targets(env.goal), float), to_numpy(env.steps) == 0
        own = env.restated({agent: observations[agent] for agent in arms}, "si")
        seen = {agent: proprioception(observation) for agent, observation in own.items()}
        changes = {agent: arm.change(targets, began, to_numpy(seen[agent])) for agent, arm in arms.items()}
        furthest = np.max([arms[agent].mover.steps(*change) for agent, change in changes.items()], axis=0)
        pace = 1 / np.maximum(furthest, 1)[:, None]
        # 0 closes a jaw as -1 does, but an actor that imitates it would open the jaw as often as not.
        return {
            agent: like(seen[agent], arms[agent].mover.action(command, pace * change, jaw=-1.0))
            for agent, (command, change) in changes.items()
        }


class _Guide:
    """Inverse kinematics of one arm's targets, from step to step."""

    def __init__(self, env: BatchedEnv, agent: str, index: int) -> None:
        self.index, self.arm, joints = index, env.scene.mounts[agent].arm, env.scene.mounts[agent].arm.actuated
        self.dt = env.control_dt
        self.lag = np.array([joint.drive.damping / joint.drive.stiffness for joint in joints])
        self.mover = TargetMover(env, agent)
        self.q = np.tile(self.arm.home, (env.num_envs, 1))
        self.targets = np.full((env.num_envs, 3), np.nan)  # of the last step; unknown at first
        self.wanted = self._on_target if env.task.follows else self._at_target
        self.terms = env.observation_terms(agent)
        if missing := {"qpos", "command"} - self.terms.keys():
            raise ValueError(f"the oracle needs to observe {' and '.join(sorted(missing))} of {agent!r}")

    def change(self, targets: np.ndarray, began: np.ndarray, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the commands [N, n], and by how much they have to change for targets [N, arms, 3], [N, n]."""
        wanted = self.wanted(targets[:, self.index], observation[:, self.terms["qpos"]], began)
        command = observation[:, self.terms["command"]]
        return command, np.clip(wanted, self.arm.lower, self.arm.upper) - command

    def _at_target(self, targets: np.ndarray, qpos: np.ndarray, began: np.ndarray) -> np.ndarray:
        """Return the commands [N, n] that hold tips at targets [N, 3], near to where joints `qpos` began."""
        rows = np.flatnonzero(began)
        self.q[rows] = qpos[rows]
        if len(rows):
            self.q[rows] = inverse_kinematics(self.arm, targets[rows], qpos[rows], starts=STARTS, iterations=FIRST)
        self.q = inverse_kinematics(self.arm, targets, self.q, starts=1, iterations=ITERATIONS)
        return self.q

    def _on_target(self, targets: np.ndarray, qpos: np.ndarray, began: np.ndarray) -> np.ndarray:
        """Return the commands [N, n] that keep tips on targets [N, 3] that move.

        They depend on nothing that an agent does not observe, so that it can imitate them: an arm that was pushed goes
        on from where it is, and not back to where it would have been.
        """
        step = np.where(began[:, None], 0.0, np.nan_to_num(targets - self.targets))
        self.targets = targets
        q = inverse_kinematics(self.arm, targets, qpos, starts=1, iterations=NEAR)
        velocity = (inverse_kinematics(self.arm, targets + step, q, starts=1, iterations=AHEAD) - q) / self.dt
        return np.asarray(q + (self.dt + self.lag) * velocity + np.maximum(self.lag / CATCH_UP - 1, 0.0) * (q - qpos))
