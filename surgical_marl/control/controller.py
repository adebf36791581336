"""The action terms of all agents of a scene: actions in, commands of actuators out.

    controller = Controller(scene, dt=0.02)
    ctrl, infos = controller.command(physics.ctrl, physics.qpos, actions)

An agent's action is the numbers of its terms, one after the other: those of the control, then the jaw's, if its arm has
a jaw.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from surgical_marl.control.action_term import ActionTerm, Jaw, Joints
from surgical_marl.plugins.controls import CONTROLS
from surgical_marl.runtime import jnp
from surgical_marl.scenes.scene import Scene

if TYPE_CHECKING:
    from jax import Array


class Controller:
    """The controllers of all arms of a scene.

    Args:
        scene: the arms, loaded with `actuators_of(control)`.
        control: a name of `list_controls()`.
        dt: time of a control step, s.
        frame: the frame that actions refer to.

    Attributes:
        scene: the arms.
        terms: agent -> name -> term, in the order of the agent's action.

    Raises:
        ValueError: an unknown control, or a frame that the control or the scene does not have.
    """

    def __init__(self, scene: Scene, control: str = "position", *, dt: float, frame: str = "base") -> None:
        self.terms = {agent: _terms(scene, agent, control, dt, frame) for agent in scene.agents}
        self.scene = scene
        names = [scene.model.actuator(i).name for i in range(scene.model.nu)]
        self._qpos = {agent: scene.qpos_index(agent) for agent in scene.agents}
        self._ctrl = {
            agent: np.array([names.index(f"{agent}/{joint.name}") for joint in mount.arm.actuated])
            for agent, mount in scene.mounts.items()
        }
        joints = np.flatnonzero(scene.model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
        # in the order of the actuators, which is that of each arm's joints
        addresses = scene.model.jnt_qposadr[scene.model.actuator_trnid[joints, 0]]
        self._moment = np.asarray(scene.moment[:, addresses], np.float32)

    @property
    def classes(self) -> tuple[type, ...]:
        """The classes of the terms."""
        return tuple(dict.fromkeys(type(term) for own in self.terms.values() for term in own.values()))

    def slices(self, agent: str) -> dict[str, slice]:
        """Return the names of an agent's terms, and where each stands in its action."""
        found, start = {}, 0
        for name, term in self.terms[agent].items():
            found[name] = slice(start, start + term.size)
            start += term.size
        return found

    def num_actions(self, agent: str) -> int:
        """Return the length of an agent's action."""
        return sum(term.size for term in self.terms[agent].values())

    def command(
        self, ctrl: Array, qpos: Array, actions: Mapping[str, Array]
    ) -> tuple[Array, dict[str, dict[str, Array]]]:
        """Return the next commands of all actuators, [nu], and what the terms tell of it in infos, by agent and name.

        The actuator of a cable follows the commands of its joints.

        Args:
            ctrl: the last commands, [nu].
            qpos: the joint positions that the encoders read, [nq].
            actions: agent -> [n]; numbers beyond -1 and 1 count as these.
        """
        arms = {agent: Joints(qpos[self._qpos[agent]], ctrl[self._ctrl[agent]]) for agent in self.terms}
        infos: dict[str, dict[str, Array]] = {}
        joints = []
        for agent, terms in self.terms.items():
            clipped, own, infos[agent] = jnp.clip(actions[agent], -1.0, 1.0), arms[agent].command, {}
            for term, part in zip(terms.values(), self.slices(agent).values(), strict=True):
                found = term.to_commands(clipped[part], arms)
                own = own.at[term.joints].set(found)
                infos[agent] |= term.infos(clipped[part], arms, found)
            joints.append(self._with_followers(agent, own))
        return jnp.matmul(self._moment, jnp.concatenate(joints)), infos

    def apply(self, physics: Any, actions: Mapping[str, Array]) -> Any:
        """Return a state of `Simulator` with the next commands of all actuators."""
        return physics.with_arms(ctrl=self.command(physics.ctrl, physics.qpos, actions)[0])

    def _with_followers(self, agent: str, commands: Array) -> Array:
        """Return the commands of all moving joints of an arm from those of its actuated joints, [n].

        A joint that mimics another gets the command of that joint, times the multiplier.
        """
        arm = self.scene.mounts[agent].arm
        names = [joint.name for joint in arm.actuated]
        leaders = np.array([names.index(joint.leader) for joint in arm.joints])
        factors = np.array([joint.multiplier for joint in arm.joints], np.float32)
        by_position = arm.moves_jaw[leaders] | (self.scene.control == "position")
        offsets = np.array([joint.offset for joint in arm.joints], np.float32) * by_position
        found = commands[leaders]
        return found if (factors == 1).all() and not offsets.any() else found * factors + offsets


def _terms(scene: Scene, agent: str, control: str, dt: float, frame: str) -> dict[str, ActionTerm]:
    """Return the terms of an agent: that of the control, and the jaw's unless that one commands the jaw too."""
    cls = CONTROLS.load(control)
    if frame not in cls.frames:
        raise ValueError(f"control_frame of control {control!r} must be {' or '.join(cls.frames)}, not {frame!r}")
    own = cls(scene, agent, dt, frame)
    jaw = np.flatnonzero(own.arm.moves_jaw)
    return {control: own} if set(jaw) <= set(own.joints) else {control: own, "jaw": Jaw(scene, agent, dt)}


def actuators_of(control: str) -> str:
    """Return how the actuators of joints are driven under a control: "position", "velocity" or "torque".

    ValueError for an unknown control.
    """
    found: str = CONTROLS.load(control).actuators
    return found
