"""The physics step of a scene with objects.

As long as no arm is near an object, or touches another arm, arms and objects move on their own. Otherwise all of them
are solved together.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.arm_contacts import Pairs
from surgical_marl.physics.contact.broadphase import Joints
from surgical_marl.physics.contact.contact_model import DWELL, Fingers, Grips, Handling
from surgical_marl.physics.contact.contact_pairs import Tables
from surgical_marl.physics.contact.detection import Finder, Slots
from surgical_marl.physics.outputs import Handled, ObjectView, Touch
from surgical_marl.physics.randomisation import Factors, grown, varied
from surgical_marl.physics.solver.constraint_rows import JointRows, Rows
from surgical_marl.physics.solver.newton import Newton
from surgical_marl.physics.solver.problem import Contacts, Pressed, Problem
from surgical_marl.physics.solver.solref import response
from surgical_marl.physics.systems.arm_forces import ArmForces, apart, padded
from surgical_marl.physics.systems.arms import Kind
from surgical_marl.physics.systems.dynamics import Dynamics, Physics
from surgical_marl.physics.systems.rigid_bodies import Bodies, Masses, free_acceleration, inertias, moved, rotation
from surgical_marl.physics.systems.sleeping import settled
from surgical_marl.physics.tree_utils import absent
from surgical_marl.robots.rotation import quaternion

if TYPE_CHECKING:
    from surgical_marl.scenes.poses import Pose
    from surgical_marl.scenes.scene import Scene

GRAVITY = np.array([0.0, 0.0, -9.81], np.float32)
"""m/s2, on objects alone: arms are balanced."""


class Objects(NamedTuple):
    """The state of all free objects of a scene, and of the fingers that hold them."""

    bodies: Bodies
    grips: Grips


class _Between(NamedTuple):
    """Contacts of arms with arms."""

    rows: Rows
    pair: Array
    """Which pair each row is of, [r]."""
    penetration: Array
    """Of all pairs, m, [P]."""
    left_out: Array
    """How many contacts found no row, []."""


class Together:
    """The physics of a scene with objects."""

    def __init__(self, scene: Scene, dynamics: Dynamics, pairs: Pairs, kinds: Sequence[Kind]) -> None:
        self._pairs, self._dynamics, self._kinds, self._arms = pairs, dynamics, kinds, len(scene.agents)
        self.tables = Tables(scene)
        self.names = self.tables.names
        joints, none = scene.model.nv, np.zeros((0, 0), int)
        self._newton, self._objects_alone, self._object_alone = (
            Newton(self.tables.dofs, joints, len(self.names)),
            Newton(none, 0, len(self.names)),
            Newton(none, 0, 1),
        )
        self._finder = Finder(self.tables)
        self._eases = _eases(scene.model)[self.tables.dofs]
        """Share of the last acceleration at which friction of joints stays as it was, [a, m]."""
        self._nominal = self.tables
        self._factors: Factors | None = None

    def varied(self, factors: Factors) -> Together:
        """Return the physics of objects that differ from their files."""
        own = copy.copy(self)
        own.tables, own._factors = varied(self._nominal, factors), factors
        own._finder = Finder(own.tables)
        return own

    def start(self, scene: Scene, poses: Mapping[str, Pose]) -> Objects:
        """Return the objects at rest, at these poses or where the scene places them."""
        tables, places = self._nominal, [scene.objects[name] for name in self.names]
        k, f = tables.count, len(tables.fingers)
        centres = np.array([place.position + place.rotation @ place.object.center for place in places])
        turns = np.array([quaternion(place.rotation) for place in places])
        still = jnp.zeros((k, 6), jnp.float32)
        falls = still + jnp.append(GRAVITY, jnp.zeros(3, jnp.float32))  # until a step has found what bears them
        single = lambda x, *shape: jnp.asarray(x, jnp.float32).reshape(shape)  # noqa: E731
        facing = jnp.zeros((k, f, 4), jnp.float32).at[..., 0].set(1.0)
        zero = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
        grips = Grips(zero(k, f, 3), facing, zero(k, f), zero(k, f), zero(k, self._arms))
        position, turned = single(centres, k, 3), single(turns, k, 4)
        for name, pose in poses.items():
            o = self.names.index(name)
            centre = pose.position + rotation(pose.quaternion) @ jnp.asarray(tables.centers[o])
            position, turned = position.at[o].set(centre), turned.at[o].set(pose.quaternion)
        if self._factors is not None:
            position += grown(tables, self._factors, rotation(turned))
        return Objects(Bodies(position, turned, still, falls), grips)

    def views(self, objects: Objects) -> dict[str, ObjectView]:
        """Return the view of every free object, by name."""
        frames, centers = rotation(objects.bodies.quaternion), jnp.asarray(self.tables.centers)
        origins = objects.bodies.position - (frames @ centers[..., None])[..., 0]
        sizes = [1.0] * len(self.names) if self._factors is None else self._factors.size
        return {
            name: ObjectView(origins[o], frames[o], objects.bodies.velocity[o], sizes[o])
            for o, name in enumerate(self.names)
        }

    def handles(self, objects: Objects, arm: int) -> dict[str, Handled]:
        """Return how an arm handles every free object, by name."""
        fingers, found = list(self.tables.jaws.get(arm, ())), {}
        for o, name in enumerate(self.names):
            force, slid = (of[o, np.array(fingers, int)] for of in (objects.grips.force, objects.grips.slid))
            held = objects.grips.held[o, arm] >= DWELL
            found[name] = Handled(jnp.sum(force), held, jnp.max(slid, initial=0.0))
        return found

    def find(self, physics: Physics) -> Slots:
        """Return the patches at which objects, arms and fixed things touch, or nearly do."""
        return self._find(self._dynamics.pose(physics.qpos), physics)[0]

    def depths(self, physics: Physics) -> Array:
        """Return how deep each pair of bodies overlaps, m, [g], in the order of `tables`; negative for a distance."""
        data = self._dynamics.pose(physics.qpos)
        return self._finder.depths(data, self._finder.joints(data), physics.objects.bodies)

    def _find(self, data: Any, physics: Physics) -> tuple[Slots, Joints]:
        joints = self._finder.joints(data)
        return self._finder.find(data, joints, physics.qvel, physics.objects.bodies, self._dynamics.dt), joints

    def step(
        self, physics: Physics, touch: Touch, data: Any, overlap: Array, fields: dict[str, Array]
    ) -> tuple[Physics, Touch]:  # fmt: skip
        """Return the state after one physics step, and the hardest touch up to the start of that step.

        Args:
            physics: the state of arms and objects.
            touch: the hardest touch so far.
            data: MJX's data with the poses of the arms.
            overlap: whether any arms overlap, [].
            fields: other values of some fields of the model.
        """
        slots, joints = self._find(data, physics)
        near = overlap | (self._on_arm(slots) < self._arms).any()
        bodies = self.tables.bodies["pads"]
        fingers, arms = Fingers(data.xpos[bodies], data.xquat[bodies]), self._forces(physics, fields)

        def alone(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            objects, (qacc, change) = self._step_objects(physics.objects, slots), apart(arms)
            qvel = physics.qvel + self._dynamics.dt * self._of_joints(change)
            left_out = jnp.maximum(touch.overflow, slots.total - len(slots.number))
            qpos = physics.qpos + self._dynamics.dt * qvel
            return Physics(qpos, qvel, self._of_joints(qacc), physics.ctrl, objects), touch._replace(overflow=left_out)

        def together(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            return self._step(physics, touch, arms, slots, joints, fingers, overlap)

        return jax.lax.cond(near, together, alone, physics, touch)

    def _step_objects(self, objects: Objects, slots: Slots) -> Objects:
        """Return the objects after a step in which no arm is near."""
        if not self.names:
            return objects
        bodies, dt, none = objects.bodies, self._dynamics.dt, jnp.zeros(0)
        masses, free = self._free(bodies, slots.awake)
        felt = Handling(self.tables, self._objects_alone.twists).feel(
            slots, None, None, none, bodies, objects.grips, dt
        )
        found = self._solve_objects(masses, free, felt.contacts, slots)
        grips = objects.grips
        loose = grips._replace(force=0 * grips.force, slid=0 * grips.slid, held=0 * grips.held)
        return Objects(self._moved(bodies, found, slots), loose)

    def _moved(self, bodies: Bodies, acceleration: Array, slots: Slots) -> Bodies:
        """Return the objects after a step with accelerations [k, 6]; those at rest stay where they are."""
        dt = self._dynamics.dt

        def one(row: tuple[Bodies, Array, Array]) -> Bodies:
            body, acceleration, awake = row
            return jax.lax.cond(awake, lambda: moved(body, acceleration, dt), lambda: body)

        after: Bodies = jax.lax.map(one, (bodies, acceleration, slots.awake))
        return settled(after, self.tables.bound, slots.company)

    def _solve_objects(self, masses: Array, free: Array, contacts: Contacts, slots: Slots) -> Array:
        """Return the accelerations [k, 6] of objects that touch no arm: one by one, if none touches another."""
        none, k, total = jnp.zeros((0, 0)), len(free), slots.found
        rows = Rows(jnp.zeros((0, 0, 0)), *[jnp.zeros(0)] * 4)
        arms = none, none, JointRows(*[none] * len(JointRows._fields)), none, rows, jnp.bool_(False)

        def whole() -> Array:
            return self._objects_alone.solve(Problem(*arms, masses, free, contacts, total)).objects

        def single(row: tuple[Array, ...]) -> Array:
            number, mass, free = row
            at = lambda n: (one := contacts.at(n))._replace(first=jnp.where(one.first == number, 0, 1))  # noqa: E731
            problem = Problem(*arms, mass[None], free[None], contacts._replace(at=at), total)
            solve = lambda: self._object_alone.solve(problem).objects[0]  # noqa: E731
            return jax.lax.cond(slots.awake[number], solve, lambda: jnp.zeros(6))

        def each() -> Array:
            return jax.lax.map(single, (jnp.arange(k), masses, free))

        if k < 2:
            return whole()
        joined = (contacts.second < k) & (np.arange(len(contacts.second)) < total)
        return jax.lax.cond(joined.any(), whole, each)

    def _step(
        self, physics: Physics, touch: Touch, arms: ArmForces, slots: Slots, joints: Joints,
        fingers: Fingers, overlap: Array,
    ) -> tuple[Physics, Touch]:  # fmt: skip
        """Return the state after a step of all arms and objects together.

        The arms' damping is part of their mass matrix here, so the solver sees the velocities at the end of the step.
        """
        dt, (bodies, grips), handling = self._dynamics.dt, physics.objects, Handling(self.tables, self._newton.twists)
        felt = handling.feel(slots, joints, fingers, physics.qvel, bodies, grips, dt)
        masses, free = self._free(bodies, slots.awake)
        between = self._between(physics, overlap)
        problem = Problem(
            arms.implicit, arms.smooth, arms.joints, self._eases * arms.start, between.rows, overlap, masses, free,
            felt.contacts, slots.found,
        )  # fmt: skip
        found = self._newton.solve(problem)
        qacc = self._of_joints(found.arms)
        qvel = physics.qvel + dt * qacc
        objects = self._moved(bodies, found.objects, slots)
        shift = dt * qvel, dt * objects.velocity
        grips = handling.remember(felt, slots, found.pressed, fingers, bodies, shift, grips, dt)
        after = Physics(physics.qpos + shift[0], qvel, qacc, physics.ctrl, Objects(objects, grips))
        touch = touch._replace(
            handled=jnp.maximum(touch.handled, self._hardest(slots, found.pressed)),
            overflow=jnp.maximum(touch.overflow, slots.total - len(slots.number)),
        )
        return after, self._bumped(touch, between, found.between, overlap)

    def _forces(self, physics: Physics, fields: dict[str, Array]) -> ArmForces:
        """Return what moves the arms but for contacts."""
        dofs = self.tables.dofs
        numbers = [np.flatnonzero(np.isin(dofs[:, 0], kind.dofs[:, 0])) for kind in self._kinds]
        return padded([kind.forces(physics, fields) for kind in self._kinds], numbers, dofs < len(physics.qvel))

    def _of_joints(self, each: Array) -> Array:
        """Return what belongs to each arm's joints [a, m] by the joints' numbers, [n]."""
        n = self._dynamics.model.nv
        return jnp.zeros(n + 1).at[self.tables.dofs].set(each)[:n]

    def _between(self, physics: Physics, overlap: Array) -> _Between:
        """Return the contacts of arms with arms. There is nothing in it unless any overlap."""

        def found(_: None) -> _Between:
            data = self._dynamics.axes(physics.qpos)  # again: quicker than to keep poses until here
            distance = self._pairs.distance_by_arms(data.geom_xpos, data.geom_xmat)
            touching = self._pairs.deepest(data, distance)
            rows = self._dynamics.contact_rows(touching.jacobian, touching.distance, touching.weight, physics.qvel)
            by_arm = jnp.pad(rows.jacobian, ((0, 0), (0, 1)))[:, self.tables.dofs]
            rows = rows._replace(jacobian=by_arm)
            return _Between(rows, touching.pair, -distance, touching.left_out)

        if not self._pairs.count:
            empty = jnp.zeros(0)
            rows = Rows(jnp.zeros((0, *self.tables.dofs.shape)), empty, empty, empty, empty)
            return _Between(rows, empty, empty, jnp.int32(0))
        return jax.lax.cond(overlap, found, lambda _: absent(jax.eval_shape(lambda: found(None))), None)

    def _bumped(self, touch: Touch, between: _Between, forces: Array, overlap: Array) -> Touch:
        """Return the hardest touch with these contacts of arms with arms, and the forces [r] of their rows."""

        def bump(touch: Touch) -> Touch:
            return touch._replace(
                penetration=jnp.maximum(touch.penetration, between.penetration),
                force=jnp.maximum(touch.force, self._pairs.spread(between.pair, forces)),
                overflow=jnp.maximum(touch.overflow, between.left_out),
            )

        return jax.lax.cond(overlap, bump, lambda touch: touch, touch) if self._pairs.count else touch

    def _on_arm(self, slots: Slots) -> Array:
        """Return the arm that the patch in each slot is on, [s]; the number of arms for none."""
        arm = jnp.asarray(self.tables.owner.astype(np.int32))[slots.number]
        return jnp.where(np.arange(len(slots.number)) < slots.total, arm, self._arms)

    def _hardest(self, slots: Slots, pressed: Pressed) -> Array:
        """Return the largest normal force of a patch on each arm, N, and of one that is not a finger's, [2, a]."""
        mine = self._on_arm(slots)[:, None] == np.arange(self._arms)
        bumps = jnp.asarray(self.tables.finger == len(self.tables.fingers))[slots.number]
        force = jnp.stack([pressed.normal, jnp.where(bumps, pressed.normal, 0.0)])
        return jnp.max(jnp.where(mine, force[..., None], 0.0), 1, initial=0.0)

    def _free(self, bodies: Bodies, awake: Array) -> tuple[Array, Array]:
        """Return the mass matrices [k, 6, 6] of the objects, and their accelerations [k, 6] without contacts.

        Those at rest have none.
        """
        dt = self._dynamics.dt

        def one(row: tuple[Bodies, Masses, Array]) -> tuple[Array, Array]:
            body, masses, awake = row
            frame = rotation(body.quaternion)
            free = lambda: free_acceleration(body, masses, frame, jnp.asarray(GRAVITY), dt)  # noqa: E731
            return inertias(masses, frame), jax.lax.cond(awake, free, lambda: jnp.zeros(6))

        found: tuple[Array, Array] = jax.lax.map(one, (bodies, self.tables.masses, awake))
        return found


def _eases(model: Any) -> np.ndarray:
    """Return the share of each joint's last acceleration at which its friction is as before, [nv + 1]; 1 for no joint.

    The reference of MuJoCo's friction falls by damping times velocity: in a step, by damping * dt * acceleration.
    """
    dt, still = np.float32(model.opt.timestep), jnp.zeros(model.nv)
    _, damping, _ = response(model.dof_solref.T, model.dof_solimp.T, still, dt)
    return np.append(1 - dt * np.asarray(damping), 1.0).astype(np.float32)
