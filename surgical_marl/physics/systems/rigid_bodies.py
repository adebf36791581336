"""The free rigid bodies of a scene: where they start, how they move without contacts, and when they come to rest."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.grips import Grips, no_grips
from surgical_marl.physics.outputs import ObjectView
from surgical_marl.physics.randomisation import Factors, grown, varied
from surgical_marl.physics.systems.rigid_motion import Bodies, Masses, free_acceleration, inertias, moved, rotation
from surgical_marl.physics.systems.sleeping import Company, settled
from surgical_marl.robots.rotation import quaternion
from surgical_marl.scenes.poses import Pose
from surgical_marl.scenes.scene import Scene

GRAVITY = np.array([0.0, 0.0, -9.81], np.float32)
"""m/s2, on rigid bodies alone: arms are balanced."""


class RigidBodyState(NamedTuple):
    """The state of all free rigid bodies of a scene, and of the fingers that hold them."""

    bodies: Bodies
    grips: Grips


class RigidBodies:
    """All free rigid bodies of a scene, k of them."""

    def __init__(self, scene: Scene, dt: Any) -> None:
        self.dt, self._arms = dt, len(scene.agents)
        self.tables = self._nominal = ContactPairs(scene)
        self.names = self.tables.names
        self._places = [scene.objects[name] for name in self.names]
        self._factors: Factors | None = None

    def start(self, poses: Mapping[str, Pose]) -> RigidBodyState:
        """Return the bodies at rest, at these poses or where the scene places them."""
        tables, places = self._nominal, self._places
        k = tables.count
        centres = np.array([place.position + place.rotation @ place.object.center for place in places], np.float32)
        turns = np.array([quaternion(place.rotation) for place in places], np.float32)
        still = jnp.zeros((k, 6), jnp.float32)
        falls = still + jnp.append(GRAVITY, jnp.zeros(3, jnp.float32))  # until a step has found what bears them
        position, turned = jnp.asarray(centres).reshape(k, 3), jnp.asarray(turns).reshape(k, 4)
        for name, pose in poses.items():
            o = self.names.index(name)
            centre = pose.position + rotation(pose.quaternion) @ jnp.asarray(tables.centers[o])
            position, turned = position.at[o].set(centre), turned.at[o].set(pose.quaternion)
        if self._factors is not None:
            position += grown(tables, self._factors, rotation(turned))
        return RigidBodyState(Bodies(position, turned, still, falls), no_grips(k, len(tables.fingers), self._arms))

    def free_motion(self, bodies: Bodies, awake: Array) -> tuple[Array, Array]:
        """Return mass matrices [k, 6, 6], and accelerations without contacts [k, 6]; none of a body at rest."""

        def one(row: tuple[Bodies, Masses, Array]) -> tuple[Array, Array]:
            body, masses, awake = row
            frame = rotation(body.quaternion)

            def falls() -> Array:
                return free_acceleration(body, masses, frame, jnp.asarray(GRAVITY), self.dt)

            return inertias(masses, frame), jax.lax.cond(awake, falls, lambda: jnp.zeros(6))

        found: tuple[Array, Array] = jax.lax.map(one, (bodies, self.tables.masses, awake))
        return found

    def apply(self, bodies: Bodies, acceleration: Array, awake: Array, company: Company) -> Bodies:
        """Return the bodies after a step with accelerations [k, 6].

        Those that are not `awake` [k] stay where they are; those that have come to rest are still from now on.
        """

        def one(row: tuple[Bodies, Array, Array]) -> Bodies:
            body, acceleration, awake = row
            return jax.lax.cond(awake, lambda: moved(body, acceleration, self.dt), lambda: body)

        after: Bodies = jax.lax.map(one, (bodies, acceleration, awake))
        return settled(after, self.tables.bound, company)

    def view(self, bodies: Bodies) -> dict[str, ObjectView]:
        """Return the view of every free body, by name."""
        frames, centers = rotation(bodies.quaternion), jnp.asarray(self.tables.centers)
        origins = bodies.position - (frames @ centers[..., None])[..., 0]
        sizes = [1.0] * len(self.names) if self._factors is None else self._factors.size
        return {
            name: ObjectView(origins[o], frames[o], bodies.velocity[o], sizes[o]) for o, name in enumerate(self.names)
        }

    def randomise(self, factors: Factors) -> RigidBodies:
        """Return bodies whose size, mass and friction differ from their files by these factors."""
        own = copy.copy(self)
        own.tables, own._factors = varied(self._nominal, factors), factors
        return own
