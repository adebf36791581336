"""The arms: joint systems that contacts push, stepped arm by arm wherever they touch nothing.

    arms = Arms(scene)
    state = arms.start(qpos, ctrl)
    forces = arms.free_motion(state)
    state = arms.apply(state, *accelerations_apart(forces))

Gravity is off, so arms of one type move in the same way wherever they stand. Each arm is stepped in its own base frame,
and one loop steps all arms of a type: the instruction cache of a GPU has no room for a copy of the code per arm.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.physics.solver.cholesky import packed, solve_positive
from surgical_marl.physics.solver.constraint_rows import JointRows, relax, rows_of, solve
from surgical_marl.physics.solver.solref import response
from surgical_marl.physics.state import ArmState
from surgical_marl.physics.systems.dynamics import Dynamics
from surgical_marl.scenes.build import alone
from surgical_marl.scenes.scene import Scene, payload_body

ITERATIONS = (1, 1)
"""Newton steps, and line search steps in each, of an arm that touches nothing, after `relax`."""


class ArmForces(NamedTuple):
    """Forces on a arms with m joints each, without contacts, [a, ...]; or those on one arm."""

    mass: Array
    """Mass matrices, the m (m + 1) / 2 elements of the lower half, [a, ...]."""
    implicit: Array
    """Mass matrices plus dt times the damping matrices, which a step treats implicitly, likewise."""
    smooth: Array
    """Sums of all forces except constraint forces, [a, m]."""
    joints: JointRows
    """Friction and limits, [a, m]."""
    start: Array
    """Accelerations of the step before, where the solver begins, [a, m]."""


class ArmType:
    """The arms of one type in a scene, stepped by the dynamics of one arm alone."""

    def __init__(self, scene: Scene, agents: tuple[str, ...]) -> None:
        model = scene.model
        self.dynamics = Dynamics(alone(scene, agents[0]))
        joints, bodies, actuators = (
            np.array([get(i).name.split("/")[0] for i in range(count)])
            for get, count in ((model.joint, model.njnt), (model.body, model.nbody), (model.actuator, model.nu))
        )
        self.dofs, self._bodies, self._actuators = (
            np.stack([np.flatnonzero(owners == agent) for agent in agents]) for owners in (joints, bodies, actuators)
        )
        """The joints of each arm by their numbers in the scene, [a, m], and so its bodies and actuators."""

    def forces_of_one(self, state: ArmState, fields: dict[str, Array]) -> ArmForces:
        """Return the forces on one arm, with other values of some fields of its model."""
        dynamics = self.dynamics.varied(fields)
        found = dynamics.forces(state)
        lower, implicit = np.tril_indices(len(state.qpos)), found.mass + dynamics.dt * found.damping
        return ArmForces(
            found.mass[lower], implicit[lower], found.smooth, dynamics.joint_rows(found.rows), state.qacc_warmstart
        )

    def each(self, state: ArmState, fields: dict[str, Array]) -> tuple[ArmState, dict[str, Array]]:
        """Return the state of each of these arms, [a, ...], and its values of fields of the scene's model."""
        dofs, actuators = self.dofs, self._actuators
        own = ArmState(state.qpos[dofs], state.qvel[dofs], state.qacc_warmstart[dofs], state.ctrl[actuators])
        where = {"actuator": actuators, "dof": dofs, "body": np.insert(self._bodies, 0, 0, axis=1)}
        return own, {name: field[where[name.split("_")[0]]] for name, field in fields.items()}


class Arms:
    """All arms of a scene.

    Rows [a, m] hold m numbers for each arm, where m is the number of joints of the arm with the most. `dofs` [a, m] are
    the joints' numbers in the scene, and the number of all joints where an arm has fewer.
    """

    def __init__(self, scene: Scene) -> None:
        self.dynamics = Dynamics(scene.model)
        self.dt, self._scene = self.dynamics.dt, scene
        self.types = [ArmType(scene, agents) for agents in scene.types.values()]
        self.dofs = joint_numbers(scene)
        self._fields: dict[str, Array] = {}
        self._friction_decay = _friction_decay(scene.model)[self.dofs]

    def start(self, qpos: Any, ctrl: Any) -> ArmState:
        """Return arms at rest at joint positions [nq], with these commands [nu]."""
        still = jnp.zeros(self._scene.model.nv, jnp.float32)
        return ArmState(qpos, still, still, ctrl)

    def free_motion(self, state: ArmState) -> ArmForces:
        """Return the forces on all arms without contacts, [a, ...]."""
        found = []
        for of in self.types:
            own = of.each(state, self._fields)
            found.append(jax.lax.map(lambda row, of=of: of.forces_of_one(*row), own))
        return self._all_types(found)

    def step_apart(self, state: ArmState) -> ArmState:
        """Return arms that touch nothing after a step: from the forces on an arm to its next state in one loop."""
        for of in self.types:
            own, fields = of.each(state, self._fields)

            def next_arm(queue: Any, _: None, of: ArmType = of) -> tuple[Any, None]:
                first, own_fields = jax.tree.map(lambda x: x[0], queue)
                moved = _moved(first, *_apart(of.forces_of_one(first, own_fields)), self.dt), own_fields
                return jax.tree.map(lambda x, y: jnp.concatenate([x[1:], y[None]]), queue, moved), None

            (own, _), _ = jax.lax.scan(next_arm, (own, fields), None, length=len(of.dofs))
            qpos, qvel, qacc = (part.at[of.dofs].set(found) for part, found in zip(state[:3], own[:3], strict=True))
            state = ArmState(qpos, qvel, qacc, state.ctrl)
        return state

    def apply(self, state: ArmState, acceleration: Array, change: Array | None = None) -> ArmState:
        """Return the arms after a step.

        Args:
            state: at its start.
            acceleration: that the solver found, [a, m]; the next step begins with it.
            change: acceleration by which velocities change, [a, m], if it is another one (see `implicit_change`).
        """
        qacc = self.by_joint(acceleration)
        return _moved(state, qacc, qacc if change is None else self.by_joint(change), self.dt)

    def randomise(
        self, stiffness: Array, damping: Array, friction: Array, payload: Array, misread: Any
    ) -> Arms:  # fmt: skip
        """Return arms that differ from their models.

        Args:
            stiffness: factors of the stiffness of every actuator, [nu].
            damping: factors of the damping of every actuator, [nu].
            friction: factors of the friction of every joint, [nv].
            payload: masses at the tool tips, [arms], kg; used only if the scene has room for them.
            misread: by how much each actuator misreads its position, [nu], rad or m.
        """
        model, nominal, scene = self.dynamics.model, self._scene.model, self._scene
        by_position = nominal.actuator_biasprm[:, 1] != 0
        by_velocity = ~by_position & (nominal.actuator_biasprm[:, 2] != 0)
        gain = jnp.where(by_position, stiffness, jnp.where(by_velocity, damping, 1.0))
        pull = model.actuator_biasprm[:, 1] * stiffness
        bias = jnp.stack([pull * misread, pull, model.actuator_biasprm[:, 2] * damping], -1)
        loaded = scene.mounts if scene.randomisation.payload else {}
        bodies = [nominal.body(payload_body(agent, mount.arm)).id for agent, mount in loaded.items()]
        varied = copy.copy(self)
        varied._fields = {
            "actuator_gainprm": model.actuator_gainprm.at[:, 0].set(model.actuator_gainprm[:, 0] * gain),
            "actuator_biasprm": model.actuator_biasprm.at[:, :3].set(bias),
            "dof_frictionloss": model.dof_frictionloss * friction,
            "dof_damping": model.dof_damping * friction,
            "body_mass": model.body_mass.at[np.array(bodies, int)].set(payload[: len(bodies)]),
        }
        return varied

    def by_joint(self, rows: Array) -> Array:
        """Return numbers of all joints [n] from rows [a, m]."""
        n = self._scene.model.nv
        return jnp.zeros(n + 1).at[self.dofs].set(rows)[:n]

    def friction_start(self, forces: ArmForces) -> Array:
        """Return accelerations [a, m] at which friction of joints is the same as at the end of the step before.

        The reference of MuJoCo's friction falls by damping times velocity: in a step by damping * dt * acceleration.
        """
        return self._friction_decay * forces.start

    def _all_types(self, types: Sequence[ArmForces]) -> ArmForces:
        """Return the forces on all arms from those on the arms of each type.

        A joint that an arm does not have gets a mass of 1 and no force.
        """
        if len(types) == 1:
            return types[0]
        (a, m), there = self.dofs.shape, self.dofs < self._scene.model.nv
        lower, none = np.zeros((a, m * (m + 1) // 2), np.float32), jnp.zeros((a, m))
        lower[:, np.diag(packed(m))] = ~there
        mass = jnp.asarray(lower)
        all_ = ArmForces(mass, mass, none, JointRows(*[none] * len(JointRows._fields)), none)
        for of, own in zip(self.types, types, strict=True):
            arms = np.flatnonzero(np.isin(self.dofs[:, 0], of.dofs[:, 0]))
            all_ = jax.tree.map(lambda x, its, arms=arms: x.at[arms, : its.shape[1]].set(its), all_, own)
        return all_


def relaxed(forces: ArmForces) -> Array:
    """Return accelerations [a, m] near those of arms without contacts, by sweeps over joints (`relax`)."""
    found: Array = jax.lax.map(_relaxed, forces)
    return found


def accelerations_apart(forces: ArmForces) -> tuple[Array, Array]:
    """Return accelerations of arms that touch nothing, and those by which their velocities change, [a, m] each."""
    found: tuple[Array, Array] = jax.lax.map(_apart, forces)
    return found


def implicit_change(forces: ArmForces, acceleration: Array) -> Array:
    """Return accelerations [a, m] by which velocities change, from those that the solver found, [a, m].

    Damping is taken at the end of the step: (M + dt D) change = M acceleration, as MuJoCo's integrator
    `implicitfast` does.
    """
    found: Array = jax.lax.map(lambda row: _implicit_change(*row), (forces, acceleration))
    return found


def _apart(arm: ArmForces) -> tuple[Array, Array]:
    qacc, _ = solve(_whole(arm.mass), arm.smooth, rows_of(arm.joints), _relaxed(arm), *ITERATIONS)
    return qacc, _implicit_change(arm, qacc)


def _relaxed(arm: ArmForces) -> Array:
    return relax(_whole(arm.mass), arm.smooth, arm.joints, arm.start)


def _implicit_change(arm: ArmForces, qacc: Array) -> Array:
    return solve_positive(_whole(arm.implicit), _whole(arm.mass) @ qacc)


def _moved(state: ArmState, qacc: Array, change: Array, dt: Any) -> ArmState:
    qvel = state.qvel + dt * change
    return ArmState(state.qpos + dt * qvel, qvel, qacc, state.ctrl)


def _whole(lower: Any) -> Array:
    """Return a symmetric matrix from its lower half."""
    m = round((np.sqrt(8 * len(lower) + 1) - 1) / 2)
    found: Array = lower[packed(m)]
    return found


def joint_numbers(scene: Scene) -> np.ndarray:
    """Return the numbers of each arm's joints among the scene's degrees of freedom, [a, m].

    An arm with fewer joints than others has that of no joint, `nv`, in its last places.
    """
    model = scene.model
    owner = np.array([model.joint(i).name.split("/")[0] for i in range(model.njnt)])
    joints = [np.flatnonzero(owner == agent) for agent in scene.agents]
    numbers = np.full((len(joints), max(map(len, joints), default=0)), model.nv)
    for arm, own in enumerate(joints):
        numbers[arm, : len(own)] = own
    return numbers


def _friction_decay(model: mujoco.MjModel) -> np.ndarray:
    """Return by what to multiply last accelerations, so that friction is as in the last step, [nv + 1]; last a 1."""
    dt, still = np.float32(model.opt.timestep), jnp.zeros(model.nv)
    _, damping, _ = response(model.dof_solref.T, model.dof_solimp.T, still, dt)
    return np.append(1 - dt * np.asarray(damping), 1.0).astype(np.float32)
