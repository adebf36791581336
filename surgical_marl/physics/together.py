"""The physics step of a scene with objects.

As long as no arm is near an object, or touches another arm, arms and objects move on their own. Otherwise all of them
are solved together.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.bodies import Bodies, free_acceleration, inertias, moved, rotation
from surgical_marl.physics.collision import Pairs
from surgical_marl.physics.cone import Forces, solve_contacts
from surgical_marl.physics.dynamics import Dynamics, Physics
from surgical_marl.physics.handling import DWELL, Felt, Grips, Handling
from surgical_marl.physics.solver import Rows
from surgical_marl.physics.views import Handled, ObjectView, Touch
from surgical_marl.robots.rotation import quaternion

if TYPE_CHECKING:
    from surgical_marl.scenes.poses import Pose
    from surgical_marl.scenes.scene import Scene

ITERATIONS = (8, 4)
"""Most Newton steps, and line search steps in each: see docs/physics.md."""
GRAVITY = np.array([0.0, 0.0, -9.81], np.float32)
"""m/s2, on objects alone: arms are balanced."""
NEAR = 1e-3
"""Distance of an arm from an object or a fixed thing below which all is solved together, m. An arm moves less in a
step."""


class Objects(NamedTuple):
    """The state of all free objects of a scene, and of the fingers that hold them."""

    bodies: Bodies
    grips: Grips


class Together:
    """The physics of a scene with objects."""

    def __init__(self, scene: Scene, dynamics: Dynamics, pairs: Pairs) -> None:
        self._handling, self._alone, self._pairs = Handling(scene), Handling(scene, arms=False), pairs
        tables = self._handling.tables
        self.names = tables.names
        self._dynamics, self._arms = dynamics, len(scene.agents)
        self._mine = tables.owner[:, None] == np.arange(self._arms)  # [g, a]

    def start(self, scene: Scene, poses: Mapping[str, Pose]) -> Objects:
        """Return the objects at rest, at these poses or where the scene places them."""
        tables, places = self._handling.tables, [scene.objects[name] for name in self.names]
        k, f = tables.count, len(tables.fingers)
        centres = np.array([place.position + place.rotation @ place.object.center for place in places])
        turns = np.array([quaternion(place.rotation) for place in places])
        still = jnp.zeros((k, 6), jnp.float32)
        single = lambda x, *shape: jnp.asarray(x, jnp.float32).reshape(shape)  # noqa: E731
        facing = jnp.zeros((k, f, 4), jnp.float32).at[..., 0].set(1.0)
        zero = lambda *shape: jnp.zeros(shape, jnp.float32)  # noqa: E731
        grips = Grips(zero(k, f, 3), facing, zero(k, f), zero(k, f), zero(k, self._arms))
        position, turned = single(centres, k, 3), single(turns, k, 4)
        for name, pose in poses.items():
            o = self.names.index(name)
            centre = pose.position + rotation(pose.quaternion) @ jnp.asarray(tables.centers[o])
            position, turned = position.at[o].set(centre), turned.at[o].set(pose.quaternion)
        return Objects(Bodies(position, turned, still, still), grips)

    def views(self, objects: Objects) -> dict[str, ObjectView]:
        """Return the view of every free object, by name."""
        frames, centers = rotation(objects.bodies.quaternion), jnp.asarray(self._handling.tables.centers)
        origins = objects.bodies.position - (frames @ centers[..., None])[..., 0]
        return {n: ObjectView(origins[o], frames[o], objects.bodies.velocity[o]) for o, n in enumerate(self.names)}

    def handles(self, objects: Objects, arm: int) -> dict[str, Handled]:
        """Return how an arm handles every free object, by name."""
        fingers, found = list(self._handling.tables.jaws.get(arm, ())), {}
        for o, name in enumerate(self.names):
            force, slid = (of[o, np.array(fingers, int)] for of in (objects.grips.force, objects.grips.slid))
            held = objects.grips.held[o, arm] >= DWELL
            found[name] = Handled(jnp.sum(force), held, jnp.max(slid, initial=0.0))
        return found

    def step(self, physics: Physics, touch: Touch, fields: dict[str, Array], apart: Callable[..., Any]) -> Any:
        """Return the state after one physics step, and the hardest touch up to the start of that step.

        Args:
            physics: the state of arms and objects.
            touch: the hardest touch so far.
            fields: other values of some fields of the model.
            apart: steps arms that touch nothing.
        """
        data = self._dynamics.pose(physics.qpos)
        near = self._pairs.overlap(data.geom_xpos, data.geom_xmat) if self._pairs.count else jnp.bool_(False)
        depth = self._handling.find(data, physics.objects.bodies).points.depth.max(-1)
        near |= jnp.max(jnp.where(self._mine.any(1), depth, -1.0), initial=-1.0) > -NEAR

        def alone(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            objects = self._step_objects(physics.objects)
            physics, touch = apart(physics, touch)
            return physics._replace(objects=objects), touch

        def together(physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
            return self._step(self._dynamics.varied(fields), physics, touch)

        return jax.lax.cond(near, together, alone, physics, touch)

    def _step_objects(self, objects: Objects) -> Objects:
        """Return the objects after a step in which no arm is near."""
        handling, bodies, dt = self._alone, objects.bodies, self._dynamics.dt
        masses, free = self._free(bodies)
        k = bodies.position.shape[0]
        if k and len(handling.tables.stiffness):
            felt = handling.feel(handling.find(None, bodies, None, dt), None, bodies, jnp.zeros(0), objects.grips, dt)
            none = jnp.zeros(0)
            rows = Rows(jnp.zeros((0, 6 * k)), none, none, none, none)
            mass, smooth = _blocks(jnp.zeros((0, 0)), masses), (masses @ free[..., None]).ravel()
            found = solve_contacts(mass, smooth, rows, felt.cones, bodies.acceleration.ravel(), *ITERATIONS)
            free = found.acceleration.reshape(k, 6)
        grips = objects.grips
        loose = grips._replace(force=0 * grips.force, slid=0 * grips.slid, held=0 * grips.held)
        return Objects(moved(bodies, free, dt), loose)

    def _step(self, dynamics: Dynamics, physics: Physics, touch: Touch) -> tuple[Physics, Touch]:
        """Return the state after a step of all arms and objects together.

        The arms' damping is part of their mass matrix here, so the solver sees the velocities at the end of the step.
        """
        dt, (bodies, grips), handling = dynamics.dt, physics.objects, self._handling
        forces, n, k = dynamics.forces(physics), len(physics.qvel), len(self.names)
        data = forces.data
        felt = handling.feel(handling.find(data, bodies, data, dt), data, bodies, physics.qvel, grips, dt)
        masses, free = self._free(bodies)
        mass = _blocks(forces.mass + dt * forces.damping, masses)
        smooth = jnp.concatenate([forces.smooth, (masses @ free[..., None]).ravel()])
        joints = len(forces.rows.low)
        rows, touching, closest = forces.rows, None, None
        if self._pairs.count:
            closest = self._pairs.closest(data.geom_xpos, data.geom_xmat)
            touching = self._pairs.deepest(data, closest)
            between = dynamics.contact_rows(touching.jacobian, touching.distance, touching.weight, physics.qvel)
            rows = Rows(*(jnp.concatenate(parts) for parts in zip(rows, between, strict=True)))
        wide = jnp.concatenate([rows.jacobian, jnp.zeros((len(rows.low), 6 * k))], 1)
        start = jnp.concatenate([dynamics.relaxed(forces, physics.qacc_warmstart), bodies.acceleration.ravel()])
        found = solve_contacts(mass, smooth, rows._replace(jacobian=wide), felt.cones, start, *ITERATIONS)
        velocity = jnp.concatenate([physics.qvel, bodies.velocity.ravel()])
        shift = dt * (velocity + dt * found.acceleration)
        grips = handling.remember(felt, found.forces, data, bodies, shift, grips, dt)
        qacc, qvel = found.acceleration[:n], shift[:n] / dt
        objects = Objects(moved(bodies, found.acceleration[n:].reshape(k, 6), dt), grips)
        after = Physics(physics.qpos + shift[:n], qvel, qacc, physics.ctrl, objects)
        handled = jnp.maximum(touch.handled, self._hardest(felt, found.forces))
        if touching is None or closest is None:
            return after, touch._replace(handled=handled)
        its_own = touching.pair == np.arange(self._pairs.count)[:, None]
        each = jnp.where(its_own, found.rows[joints:], 0.0).sum(-1)
        penetration = jnp.maximum(touch.penetration, -closest.distance)
        return after, Touch(penetration, jnp.maximum(touch.force, each), handled)

    def _hardest(self, felt: Felt, forces: Forces) -> Array:
        """Return the largest normal force of a patch on each arm, N, [a]."""
        pressed = forces.normal.sum(-1)
        return jnp.max(jnp.where(self._mine, pressed[:, None], 0.0), 0, initial=0.0)

    def _free(self, bodies: Bodies) -> tuple[Array, Array]:
        """Return the mass matrices [k, 6, 6] of the objects, and their accelerations [k, 6] without contacts."""
        frames, masses = rotation(bodies.quaternion), self._handling.tables.masses
        free = free_acceleration(bodies, masses, frames, jnp.asarray(GRAVITY), self._dynamics.dt)
        return inertias(masses, frames), free


def _blocks(arms: Array, objects: Array) -> Array:
    """Return the matrix with the arms' [n, n] and the objects' [k, 6, 6] along its diagonal."""
    n, k = len(arms), len(objects)
    mass = jnp.zeros((n + 6 * k, n + 6 * k)).at[:n, :n].set(arms)
    for o in range(k):
        own = slice(n + 6 * o, n + 6 * o + 6)
        mass = mass.at[own, own].set(objects[o])
    return mass
