"""From rows of actions, as data sets have them, to an environment's own actions: the way back from `Signals.action`.

targets = rows.targets(row, measured, command)            # when a row begins
actions = rows.actions(targets, command, left=2)          # in each of its control steps
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.policies.signals import Signals
from surgical_marl.policies.target_mover import TargetMover
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.tasks.base.grasp_poses import frames

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.robots.arm import Arm

Joints = Mapping[str, np.ndarray]
"""Numbers of each agent's joints, [n, joints]."""


class RowActions:
    """Executes rows of actions.

    Args:
        env: the environments.
        signals: the form of the rows.
    """

    def __init__(self, env: BatchedEnv, signals: Signals) -> None:
        self._signals, self._parts = signals, signals.parts(signals.action_names)
        self._movers = {} if signals.form == "env" else {agent: TargetMover(env, agent) for agent in signals.arms}
        self._dt = env.control_dt

    def targets(self, rows: np.ndarray, measured: Joints, command: Joints) -> dict[str, np.ndarray]:
        """Return where rows of actions want each agent's joints at their end, [n, joints]; of the form env, its action.

        Args:
            rows: [n, a].
            measured: positions that the joints measure when the row begins, rad or m.
            command: their position targets then.
        """
        found = {}
        for agent, part in self._parts.items():
            own, arm = rows[:, part].astype(float), self._signals.arms[agent]
            if self._signals.form == "env":
                found[agent] = own
                continue
            if self._signals.form == "joint":
                wanted = own
            else:
                poses = _absolute(own) if self._signals.form == "cartesian" else _ahead(arm, measured[agent], own)
                wanted = inverse_kinematics(arm, poses, command[agent].astype(float), starts=1)
                if arm.moves_jaw.any():
                    wanted[:, arm.moves_jaw] = own[:, -1:]
            found[agent] = np.clip(wanted, arm.lower, arm.upper)
        return found

    def actions(self, targets: Joints, command: Joints, left: np.ndarray | int) -> dict[str, np.ndarray]:
        """Return the actions [n, a] of the next control step; numbers may be beyond -1 and 1.

        Args:
            targets: of `targets`.
            command: the position targets now, [n, joints].
            left: control steps until the row ends, this one included, [n] or for all.
        """
        if self._signals.form == "env":
            return {agent: np.asarray(own) for agent, own in targets.items()}
        found = {}
        for agent, mover in self._movers.items():
            arm, now = self._signals.arms[agent], command[agent].astype(float)
            change = (targets[agent] - now) / np.reshape(left, (-1, 1))
            found[agent] = mover.action(now, change, self._jaw(arm, now, change))
        return found

    def _jaw(self, arm: Arm, command: np.ndarray, change: np.ndarray) -> np.ndarray | float:
        """Return 1 where opening, and -1 where closing, brings the jaw's target nearer to where it should be, [n]."""
        if arm.jaw is None:
            return 0.0
        now, aim = (part[:, arm.moves_jaw][:, 0] for part in (command, command + change))
        reach = self._dt * arm.speed[arm.moves_jaw][0]
        ends = (arm.jaw.open, arm.jaw.closed)
        opened, closed = (np.abs(now + np.clip(end - now, -reach, reach) - aim) for end in ends)
        return np.where(opened < closed, 1.0, -1.0)


def _absolute(rows: np.ndarray) -> np.ndarray:
    """Return tips [n, 4, 4] of x, y, z and a quaternion x, y, z, w of any length, [n, 7 or more]."""
    turns = rows[:, [6, 3, 4, 5]]
    return frames(rows[:, :3], turns / _length(turns))


def _ahead(arm: Arm, measured: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return tips [n, 4, 4] that are where rows say in the frame of the measured tip (`Signals`: relative)."""
    first, second = rows[:, 3:6], rows[:, 6:9]
    first = first / _length(first)
    second = second - (first * second).sum(1, keepdims=True) * first
    second = second / _length(second)
    move = np.tile(np.eye(4), (len(rows), 1, 1))
    move[:, :3, :3] = np.stack([first, second, np.cross(first, second)], -1)
    move[:, :3, 3] = rows[:, :3]
    return np.asarray(arm.forward_kinematics(measured.astype(float))) @ move


def _length(vectors: np.ndarray) -> np.ndarray:
    """Return lengths [n, 1] of vectors [n, d], at least so much that one can divide by them."""
    return np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
