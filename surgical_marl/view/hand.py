"""An arm that a person moves: by its joints, by its tool tip, and its jaw by a button.

hand = Hand(env, "psm_0")
hand.hold(observation)                      # from where the arm is
hand.reach([0.02, 0.0, -0.01])              # the tool tip, in the world; its orientation stays
hand.jaw_open = True
action = hand(observation)                  # [N, n]
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from surgical_marl.envs.observations import proprioception
from surgical_marl.policies.target_mover import TargetMover
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.tasks.base.grasp_poses import tool_of

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv

POSED = 6
"""An arm with this many joints beside its jaw can be sent to any pose; one with fewer, to positions."""


class Hand:
    """A person's wishes for one arm, the same in all environments, as a policy of that arm.

    Commands go straight to the wanted joint positions, at the joints' speeds.

    Args:
        env: the environments, with position targets.
        agent: the arm.

    Raises:
        ValueError: the control has no position targets, or the agent does not observe its command.
    """

    def __init__(self, env: BatchedEnv, agent: str) -> None:
        self._mover = TargetMover(env, agent)
        terms = env.observation_terms(agent)
        if "command" not in terms:
            raise ValueError(f"a person's arm must observe its command, and {agent!r} does not")
        self._env, self._agent, self._command = env, agent, terms["command"]
        self.mount = env.scene.mounts[agent]
        self._arm = self.mount.arm
        self.jaw = self._arm.moves_jaw
        """True for joints that open the jaw, [n] bool."""
        self.jaw_open = False
        self.q = np.array(self._arm.home, float)
        """Wanted joint positions, [n]."""

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper limits of the joints, [n] each."""
        return self._arm.lower, self._arm.upper

    @property
    def joints(self) -> list[str]:
        """Names of the joints."""
        return [joint.name for joint in self._arm.actuated]

    def hold(self, observation: Any) -> None:
        """Want the arm to stay where it is sent to now in the first environment.

        Its jaw opens or closes, to whichever it is nearer.

        Args:
            observation: what the agent observes now, as in an action.
        """
        self.q = np.array(self._commands(observation)[0], float)
        if (jaw := self._arm.jaw) is not None:
            (command,) = self.q[self.jaw]
            self.jaw_open = bool(abs(command - jaw.open) < abs(command - jaw.closed))

    def set_joint(self, index: int, value: float) -> None:
        """Want another position of one joint, rad or m, cut off at its limits."""
        lower, upper = self.limits
        self.q[index] = np.clip(value, lower[index], upper[index])

    def reach(self, position: ArrayLike, rotation: ArrayLike | None = None) -> None:
        """Want the tool tip at a position [3] in the world, m, and with a rotation [3, 3] if the arm can.

        Without a rotation the tool keeps the one that is wanted. Out of reach, the arm comes as near as it can.
        """
        base = self.mount.rotation
        target = np.array(self._arm.forward_kinematics(self.q))
        target[:3, 3] = base.T @ (np.asarray(position, float) - self.mount.position)
        if rotation is not None:
            target[:3, :3] = base.T @ np.asarray(rotation, float)
        posed = np.count_nonzero(~self.jaw) >= POSED
        self.q = inverse_kinematics(self._arm, target if posed else target[:3, 3], self.q, starts=1)

    def nudge(self, step: ArrayLike) -> None:
        """Want the tool tip elsewhere by `step` [3] in the world, m."""
        self.reach(self.tip()[:3, 3] + np.asarray(step, float))

    def tip(self) -> np.ndarray:
        """Return the wanted pose of the tool tip in the world, [4, 4]."""
        return tool_of(self.mount, self.q)

    def __call__(self, observation: Any) -> np.ndarray:
        """Return the action [N, n] that moves commands towards the wanted joint positions."""
        command = self._commands(observation)
        found = self._mover.action(command, self.q - command, 1.0 if self.jaw_open else -1.0)
        return np.clip(found, -1.0, 1.0).astype(np.float32)

    def _commands(self, observation: Any) -> np.ndarray:
        """Return where the arm is sent to, [N, n]."""
        own = self._env.restated({self._agent: observation}, "si")[self._agent]
        return np.asarray(proprioception(own))[:, self._command]
