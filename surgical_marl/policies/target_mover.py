"""Actions that move the position targets of an arm's joints, under any control that has such targets.

    mover = TargetMover(env, "psm_0")
    action = mover.action(command, wanted - command, jaw=-1.0)

Scripts, people and demonstrations say where joints should be; the control's term says which numbers lead there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.control.action_term import ActionTerm, Joints
from surgical_marl.plugins.controls import CONTROLS, list_controls

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv


class TargetMover:
    """Moves the position targets of one agent's joints, in all environments of a batch.

    Args:
        env: the environments.
        agent: the agent.

    Attributes:
        jaw: the column of the jaw's number in an action; None without a jaw.

    Raises:
        ValueError: the environments' control has no position targets.
    """

    def __init__(self, env: BatchedEnv, agent: str) -> None:
        check_control(env.control)
        self._env, self._agent = env, agent
        self._term: ActionTerm = env.env.controller.terms[agent][env.control]
        self._slices = env.action_terms(agent)
        self.jaw = jaw_column(env, agent)

    def steps(self, command: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return how many control steps it takes to move targets by `change` at full speed, [N].

        Args:
            command: the targets now, [N, n].
            change: [N, n]; that of a jaw is not looked at.
        """
        return self._term.steps_of(command, change)

    def action(self, command: np.ndarray, change: np.ndarray, jaw: float | np.ndarray = 0.0) -> np.ndarray:
        """Return the action [N, a] that moves targets by `change` in a step; its message is zeros.

        Numbers are beyond -1 and 1 where that takes more than a step.

        Args:
            command: the targets now, [N, n].
            change: [N, n]; that of a jaw is not looked at.
            jaw: the number of the jaw, or [N] of them.
        """
        found = np.zeros((len(command), *(self._env.action_space(self._agent).shape or ())))
        arms = {self._agent: Joints(command, command)}
        if self._term.frame != "base":
            qpos, scene = self._env.qpos.astype(float), self._env.scene
            arms |= {a: Joints(qpos[:, scene.qpos_index(a)], command) for a in self._env.agents if a != self._agent}
        found[:, self._slices[self._env.control]] = self._term.action_of(change, arms)
        if self.jaw is not None:
            found[:, self.jaw] = jaw
        return found


def jaw_column(env: BatchedEnv, agent: str) -> int | None:
    """Return the column of the jaw's number in an agent's action; None where the jaw has no number of its own."""
    jaw = env.action_terms(agent).get("jaw")
    return None if jaw is None else jaw.start


def moves_targets(control: str) -> bool:
    """Return whether position targets of joints can be moved under a control."""
    return CONTROLS.load(control).action_of is not ActionTerm.action_of


def check_control(control: str) -> None:
    """Raise ValueError if neither the oracle nor a person can move arms under a control."""
    if not moves_targets(control):
        good = " or ".join(name for name in list_controls() if moves_targets(name))
        raise ValueError(f"the oracle and people move position targets: control must be {good}, not {control!r}")
