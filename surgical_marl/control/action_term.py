"""Action terms: the named parts of an agent's action, each with its bounds and its way to commands.

    class Push(ActionTerm):
        actuators = "torque"

        @property
        def bounds(self):
            return symmetric(np.ones(len(self.joints)))                 # N m

        def to_commands(self, action, arms):
            return action

A subclass is found by its name as tasks and algorithms are (docs/control.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np

from surgical_marl.robots.reach import Box
from surgical_marl.runtime import jnp
from surgical_marl.scenes.scene import Scene

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.robots.arm import Arm


class Joints(NamedTuple):
    """The actuated joints of an arm at the start of a control step, [n] each, in rad (m for prismatic joints).

    Arrays of JAX; on the host [N, n] of numpy.
    """

    position: Any
    """As the encoders read them."""
    command: Any
    """Their last commands: position targets, or velocities or torques."""


class ActionTerm:
    """A part of an agent's action: it turns numbers in [-1, 1] into commands of some of its arm's joints.

    Args:
        scene: the arms.
        agent: the name of the agent.
        dt: time of a control step, s.
        frame: the frame that its numbers refer to, one of `frames`.

    Attributes:
        arm: the arm of the agent.
        joints: the joints that it commands, as indices into `arm.actuated`: all but the jaw. A term that commands the
            jaw too sets it to all of them; the agent then has no separate number for the jaw.
    """

    actuators: ClassVar[Literal["position", "velocity", "torque"]] = "position"
    """Control of the joints' actuators. A jaw is always under position control."""
    frames: ClassVar[tuple[str, ...]] = ("base",)
    """The frames that its numbers can refer to: "base", that of the arm, or "camera", that of an endoscope."""

    def __init__(self, scene: Scene, agent: str, dt: float, frame: str = "base") -> None:
        self.scene, self.agent, self.dt, self.frame = scene, agent, dt, frame
        self.arm = scene.mounts[agent].arm
        self.joints = np.flatnonzero(~self.arm.moves_jaw)

    @property
    def bounds(self) -> Box:
        """Return the values that -1 and 1 stand for, [size] each, in SI units."""
        raise NotImplementedError

    @property
    def size(self) -> int:
        """Return how many numbers of the action it takes."""
        return len(self.bounds.low)

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the commands of `joints`, [k].

        Args:
            action: its numbers, [size], in [-1, 1].
            arms: the joints of every arm of the scene, by agent.
        """
        raise NotImplementedError

    def infos(self, action: Array, arms: Mapping[str, Joints], commands: Array) -> dict[str, Array]:
        """Return entries of the agent's `infos` after the step, [] each; `commands` [k] are those of `to_commands`."""
        return {}

    # -- on the host, for N environments at once: scripts and people move position targets by these two

    def steps_of(self, command: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return how many control steps a change of position targets takes at full speed, [N].

        Args:
            command: the targets of all actuated joints now, [N, n].
            change: [N, n]; only that of `joints` counts.
        """
        step = self.dt * self.arm.speed[self.joints]
        return np.asarray(np.abs(change[:, self.joints] / step).max(-1, initial=0.0))

    def action_of(self, change: np.ndarray, arms: Mapping[str, Joints]) -> np.ndarray:
        """Return the numbers [N, size] that change position targets by `change` [N, n] in a step, beyond 1 if need be.

        Args:
            change: only that of `joints` counts.
            arms: as in `to_commands`, [N, n] each.
        """
        raise NotImplementedError


class Jaw(ActionTerm):
    """The jaw of an arm: a positive number opens it, any other one closes it, at the speed of its joint."""

    def __init__(self, scene: Scene, agent: str, dt: float, frame: str = "base") -> None:
        super().__init__(scene, agent, dt, frame)
        self.joints = np.flatnonzero(self.arm.moves_jaw)

    @property
    def bounds(self) -> Box:
        """Return the positions of the closed and the open jaw, [1] each."""
        assert self.arm.jaw is not None
        return Box(np.array([self.arm.jaw.closed]), np.array([self.arm.jaw.open]))

    def to_commands(self, action: Array, arms: Mapping[str, Joints]) -> Array:
        """Return the next position target of the jaw's joint, [1]."""
        last, step = arms[self.agent].command[self.joints], self.speed * np.float32(self.dt)
        closed, opened = (end.astype(np.float32) for end in self.bounds)
        return last + jnp.clip(jnp.where(action > 0, opened, closed) - last, -step, step)

    @property
    def speed(self) -> np.ndarray:
        """Return the speed of the jaw's joint, [1], rad/s or m/s."""
        return self.arm.speed[self.joints].astype(np.float32)


def symmetric(most: np.ndarray) -> Box:
    """Return the bounds from `-most` to `most`, [size] each."""
    return Box(-most, most)


def lead_limit(arm: Arm) -> np.ndarray:
    """Return by how much the position target of each joint may lead it, [n] float32, rad or m.

    That is the lead at which a joint that moves at its full speed gets its full effort, from its own drive and its
    cables. Without a limit the target of a joint that is held in place would move further and further ahead, and the
    joint would race after it once free.
    """
    names, drives = [joint.name for joint in arm.actuated], [joint.drive for joint in arm.actuated]
    stiffness, damping = np.array([(drive.stiffness, drive.damping) for drive in drives], np.float32).T
    for cable in arm.cables:
        for name, coefficient in cable.joints.items():
            square = np.float32(coefficient) ** 2
            stiffness[names.index(name)] += square * np.float32(cable.stiffness)
            damping[names.index(name)] += square * np.float32(cable.damping)
    effort = np.array([joint.effort for joint in arm.actuated], np.float32)
    return np.asarray((effort + damping * arm.speed.astype(np.float32)) / stiffness)
