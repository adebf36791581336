"""Arms of one type: one piece of code for all of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.systems.arm_forces import ArmForces
from surgical_marl.physics.systems.dynamics import Dynamics, Physics
from surgical_marl.scenes.build import alone
from surgical_marl.scenes.scene import Scene


class Kind:
    """The arms of one type in a scene.

    Arms of one type move in the same way wherever they stand, because gravity is off. So each arm is stepped in its own
    base frame, and the same code steps all of them, one after the other. The instruction cache of a GPU has no room for
    one copy of the code per arm.
    """

    def __init__(self, scene: Scene, agents: tuple[str, ...]) -> None:
        model = scene.model
        self._dynamics = Dynamics(alone(scene, agents[0]))
        owner = lambda name: name.split("/")[0]  # noqa: E731
        joints, bodies, actuators = (
            np.array([owner(get(i).name) for i in range(count)])
            for get, count in ((model.joint, model.njnt), (model.body, model.nbody), (model.actuator, model.nu))
        )
        self.dofs, self._bodies, self._actuators = (
            np.stack([np.flatnonzero(owners == agent) for agent in agents]) for owners in (joints, bodies, actuators)
        )
        """The joints of each arm by their numbers in the scene, [a, m], and so its bodies and actuators."""

    def step(self, physics: Physics, fields: dict[str, Array]) -> Physics:
        """Return the physics of the scene after one step of these arms.

        `fields` replaces values of some fields of the scene's model.
        """
        dofs, (own, others) = self.dofs, self._own(physics, fields)

        def next_arm(queue: tuple[Physics, dict[str, Array]], _: None) -> tuple[tuple[Physics, dict[str, Array]], None]:
            first = jax.tree.map(lambda x: x[0], queue)
            moved = self._dynamics.varied(first[1]).step(first[0]), first[1]
            return jax.tree.map(lambda x, y: jnp.concatenate([x[1:], y[None]]), queue, moved), None

        (own, _), _ = jax.lax.scan(next_arm, (own, others), None, length=len(dofs))
        qpos, qvel, qacc = (part.at[dofs].set(found) for part, found in zip(physics[:3], own[:3], strict=True))
        return physics._replace(qpos=qpos, qvel=qvel, qacc_warmstart=qacc)

    def forces(self, physics: Physics, fields: dict[str, Array]) -> ArmForces:
        """Return what moves these arms. `fields` are as in `step`."""

        def of_arm(row: tuple[Physics, dict[str, Array]]) -> ArmForces:
            dynamics, own = self._dynamics.varied(row[1]), row[0]
            found = dynamics.forces(own)
            lower, implicit = np.tril_indices(len(own.qpos)), found.mass + dynamics.dt * found.damping
            joints = dynamics.joint_rows(found.rows)
            return ArmForces(found.mass[lower], implicit[lower], found.smooth, joints, own.qacc_warmstart)

        found: ArmForces = jax.lax.map(of_arm, self._own(physics, fields))
        return found

    def _own(self, physics: Physics, fields: dict[str, Array]) -> tuple[Physics, dict[str, Array]]:
        """Return the physics of each of these arms, and its values of fields."""
        dofs, actuators = self.dofs, self._actuators
        own = Physics(physics.qpos[dofs], physics.qvel[dofs], physics.qacc_warmstart[dofs], physics.ctrl[actuators])
        where = {"actuator": actuators, "dof": dofs, "body": np.insert(self._bodies, 0, 0, axis=1)}
        return own, {name: field[where[name.split("_")[0]]] for name, field in fields.items()}
