"""Contacts of systems of plug-ins with arms and rigid bodies: their ends, the loads on these, their accelerations."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.broadphase import Displacement, Joints, Placed, Places
from surgical_marl.physics.contact.contact_pairs import ContactPairs
from surgical_marl.physics.contact.shapes import Points, Segments, between_segments, on_plate
from surgical_marl.physics.solver.cholesky import cholesky, solve_factored
from surgical_marl.physics.systems.arms import ArmForces
from surgical_marl.physics.systems.rigid_motion import Bodies
from surgical_marl.physics.systems.system import Ends, Loads, Spheres
from surgical_marl.physics.tree_utils import row_of
from surgical_marl.scenes.objects import JAW, LINK, Surface


class Coupling:
    """The contacts of one system with all other shapes of a scene.

    Shapes are numbered by kind: pads of fingers, links of arms, free bodies, fixed plates, fixed rods.
    """

    def __init__(self, tables: ContactPairs, surface: Surface) -> None:
        self._tables, self._places = tables, Places(tables)
        self._counts = {"pads": len(tables.fingers), "links": len(tables.near), "objects": tables.count,
                        "plates": len(tables.plates.radius), "rods": len(tables.rods.radius)}  # fmt: skip
        others = [*[JAW] * self._counts["pads"], *[LINK] * self._counts["links"], *tables.surfaces["objects"],
                  *tables.surfaces["plates"], *tables.surfaces["rods"]]  # fmt: skip
        met = [surface.against(other) for other in others]
        self._stiffness = np.array([one.stiffness for one in met], np.float32)
        self._sliding = np.array([one.sliding for one in met], np.float32)
        count, none = len(others), tables.count
        self.arm, self.moves = np.full(count, tables.arms), np.zeros((count, tables.most), np.float32)
        """The arm that each shape is on, and which of that arm's joints move it, [m]."""
        self.body, start = np.full(count, none), 0
        """The free body that each shape is of; the number of bodies for others."""
        for kind, size in self._counts.items():
            own = slice(start, start + size)
            if kind in tables.bodies:
                self.arm[own], self.moves[own] = tables.arm_of[kind], tables.moves[kind]
            if kind == "objects":
                self.body[own] = np.arange(size)
            start += size
        self.fingers = np.arange(count) < self._counts["pads"]
        """Which shapes are pads of fingers."""

    def ends(self, spheres: Spheres, poses: Any, joints: Joints, qvel: Array, bodies: Bodies, dt: Any) -> Ends:
        """Return the ends of all contacts of spheres [n] with shapes [r], from MJX's data with poses of the arms."""
        placed = self._places.place(poses, joints, qvel, bodies, dt)
        points, velocities = [], []
        for kind in (kind for kind, size in self._counts.items() if size):
            displacement = placed.displacements.get(kind)

            def of_sphere(
                row: Any, kind: str = kind, displacement: Displacement | None = displacement
            ) -> tuple[Points, Array]:  # fmt: skip
                centre, radius = row
                sphere = Segments(centre, centre, radius)

                def meet(number: Array) -> tuple[Points, Array]:
                    point = self._point(placed, kind, number, sphere)
                    if displacement is None:
                        return point, jnp.zeros(3)
                    own = row_of(displacement, number)
                    return point, (own.shift + jnp.cross(own.turn, point.place)) / dt

                return jax.lax.map(meet, jnp.arange(self._counts[kind]))

            found = jax.lax.map(of_sphere, (spheres.centre, spheres.radius))
            points.append(found[0])
            velocities.append(found[1])
        all_ = jax.tree.map(lambda *parts: jnp.concatenate(parts, 1), *points)
        velocity = jnp.concatenate(velocities, 1)
        return Ends(all_.depth, all_.place, all_.normal, velocity, self._stiffness, self._sliding)

    def _point(self, placed: Placed, kind: str, number: Array, sphere: Segments) -> Points:
        """Return where a sphere touches one shape."""
        if kind in ("pads", "plates"):
            return row_of(on_plate(sphere, self._places.plate(placed, kind, number)), 0)
        capsules = self._places.capsules(placed, kind, number)
        points = jax.vmap(lambda capsule: between_segments(sphere, capsule))(capsules)
        return row_of(points, jnp.argmax(points.depth))

    # -- loads

    def on_arms(self, forces: ArmForces, loads: Loads, ends: Ends, joints: Joints) -> ArmForces:
        """Return the forces on arms with loads: their forces in `smooth`, their stiffness in the mass matrices."""
        a, m = forces.smooth.shape
        lower = np.tril_indices(m)

        def add(sums: ArmForces, row: Any) -> tuple[ArmForces, None]:
            arm, moves, force, stiffness, place = row

            def loaded(sums: ArmForces) -> ArmForces:
                jacobian = self._jacobian(joints, arm, moves, place)
                block = (jacobian.T @ stiffness @ jacobian)[lower]
                return sums._replace(
                    mass=sums.mass.at[arm].add(block),
                    implicit=sums.implicit.at[arm].add(block),
                    smooth=sums.smooth.at[arm].add(force @ jacobian),
                )

            touched = (arm < a) & (force != 0).any()
            return jax.lax.cond(touched, loaded, lambda sums: sums, sums), None

        rows = self._rows(loads, ends)
        return jax.lax.scan(add, forces, (rows["arm"], rows["moves"], rows["force"], rows["stiffness"], rows["place"]))[
            0
        ]

    def on_bodies(
        self, masses: Array, free: Array, loads: Loads, ends: Ends, bodies: Bodies
    ) -> tuple[Array, Array, Array]:
        """Return mass matrices [k, 6, 6] and accelerations [k, 6] of bodies with loads, and which have any, [k]."""
        k = len(free)
        if not k:
            return masses, free, jnp.zeros(0, bool)
        force = (masses @ free[..., None])[..., 0]

        def add(sums: tuple[Array, Array, Array], row: Any) -> tuple[tuple[Array, Array, Array], None]:
            body, pushed, stiffness, place = row

            def loaded(sums: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
                motion = _motion_of(place - bodies.position.at[body].get(mode="clip"))
                return (
                    sums[0].at[body].add(motion.T @ stiffness @ motion),
                    sums[1].at[body].add(pushed @ motion),
                    sums[2].at[body].set(True),
                )

            touched = (body < k) & (pushed != 0).any()
            return jax.lax.cond(touched, loaded, lambda sums: sums, sums), None

        rows = self._rows(loads, ends)
        start = masses, force, jnp.zeros(k, bool)
        (masses, force, touched), _ = jax.lax.scan(
            add, start, (rows["body"], rows["force"], rows["stiffness"], rows["place"])
        )
        return masses, jax.vmap(lambda mass, own: solve_factored(cholesky(mass), own))(masses, force), touched

    def accelerations(
        self, ends: Ends, joints: Joints, bodies: Bodies, by_arm: Array, by_body: Array
    ) -> Array:  # fmt: skip
        """Return the accelerations of the ends, m/s2, [n, r, 3], by those of joints [a, m] and of bodies [k, 6]."""
        a, k = len(by_arm), len(by_body)

        def one(row: Any) -> Array:
            arm, moves, body, place = row
            found = jnp.zeros(3)
            if a:
                found = jax.lax.cond(
                    arm < a,
                    lambda: self._jacobian(joints, arm, moves, place) @ by_arm.at[arm].get(mode="clip"),
                    lambda: jnp.zeros(3),
                )
            if k:
                motion = _motion_of(place - bodies.position.at[body].get(mode="clip"))
                found += jnp.where(body < k, motion @ by_body.at[body].get(mode="clip"), 0.0)
            return found

        rows = self._rows(None, ends)
        found: Array = jax.lax.map(one, (rows["arm"], rows["moves"], rows["body"], rows["place"]))
        return found.reshape(ends.place.shape)

    def _jacobian(self, joints: Joints, arm: Array, moves: Array, place: Array) -> Array:
        """Return the velocity of a place of a link by velocity of its arm's joints, [3, m]."""
        moving, _ = joints.columns(jnp.asarray(self._tables.slides), place)
        return (moving.at[arm].get(mode="clip") * moves[:, None]).T

    def _rows(self, loads: Loads | None, ends: Ends) -> dict[str, Array]:
        """Return the contacts of all spheres as rows, [n r], by column."""
        n = len(ends.depth)
        rows = {"arm": np.tile(self.arm, n), "moves": np.tile(self.moves, (n, 1)), "body": np.tile(self.body, n)}
        found = {name: jnp.asarray(values) for name, values in rows.items()}
        found["place"] = ends.place.reshape(-1, 3)
        if loads is not None:
            found["force"], found["stiffness"] = loads.force.reshape(-1, 3), loads.stiffness.reshape(-1, 3, 3)
        return found


def _motion_of(offset: Array) -> Array:
    """Return the matrix [3, 6] from the acceleration of a body to that of a point of it at an offset, m, [3]."""
    x, y, z = offset
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, z, -y]), jnp.stack([-z, zero, x]), jnp.stack([y, -x, zero])])
    return jnp.concatenate([jnp.eye(3), cross], 1)
