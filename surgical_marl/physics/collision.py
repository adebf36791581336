"""Distance and contact of capsules in pure JAX, for the pairs of geoms of a scene that can touch.

All collision geoms are capsules or spheres, so that a pair is two line segments with a radius each: their distance is
exact, and the same as C MuJoCo's. A physics step asks first whether anything touches (`overlap`). Few pairs touch
at a time: only the `SLOTS` deepest become constraint rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.scenes.geometry import Capsule, axis_gap

SLOTS = 6
"""Contacts at one time. Arms driven at random with full effort in all six scenes had 4 at most, in 144,000 steps."""


class Closest(NamedTuple):
    """Where the geoms of each pair are closest, [P]."""

    distance: Array
    """Signed, m: negative where they overlap."""
    point: Array
    """Midway between the two surfaces, in the world, [P, 3]."""
    normal: Array
    """Unit vector from the first geom to the second, [P, 3]."""


class Touching(NamedTuple):
    """The deepest contacts, [K] each."""

    pair: Array
    """Which pair it is."""
    distance: Array
    jacobian: Array
    """Speed along the normal by joint velocity, [K, nv]; zero where nothing touches."""
    weight: Array
    """Inverse mass of the two bodies, 1/kg."""


class Pairs:
    """The pairs of a model (`<pair>` elements between capsules and spheres)."""

    def __init__(self, model: mujoco.MjModel) -> None:
        single = np.float32
        self.count = model.npair
        self._geoms = model.pair_geom1.copy(), model.pair_geom2.copy()
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        self._halves = [
            np.where(model.geom_type[g] == capsule, model.geom_size[g, 1], 0).astype(single) for g in self._geoms
        ]
        self._radii = [model.geom_size[g, 0].astype(single) for g in self._geoms]
        bodies = [model.geom_bodyid[geoms] for geoms in self._geoms]
        self._weight = sum(model.body_invweight0[body, 0] for body in bodies).astype(single)
        moved = moved_bodies(model)
        self._sign = (moved[bodies[1]] - moved[bodies[0]]).astype(single)
        self._roots = model.body_rootid[model.dof_bodyid]

    def overlap(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return whether any pair overlaps, []: for less than what `distance` costs."""
        gap = axis_gap(*self._capsules(geom_xpos, geom_xmat))[1]
        reach = self._radii[0] + self._radii[1]
        return jnp.min(jnp.sum(gap * gap, -1) - reach * reach, initial=np.inf) < 0

    def distance(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return the signed distance of every pair, m, [P]; negative where they overlap."""
        return self.closest(geom_xpos, geom_xmat).distance

    def closest(self, geom_xpos: Array, geom_xmat: Array) -> Closest:
        """Return where the pairs are closest, from positions [ngeom, 3] and frames [ngeom, 3, 3] of all geoms."""
        one, other = self._capsules(geom_xpos, geom_xmat)
        where, gap = axis_gap(one, other)
        length = jnp.sqrt(jnp.maximum(jnp.sum(gap * gap, -1), 1e-18))
        normal = gap / length[:, None]
        distance = length - (one.radius + other.radius)
        segment = one.segment()
        point = segment.start + where[:, None] * segment.extent + (one.radius + distance / 2)[:, None] * normal
        return Closest(distance, point, normal)

    def _capsules(self, geom_xpos: Array, geom_xmat: Array) -> tuple[Capsule, Capsule]:
        """Return the capsules of the first and of the second geoms of all pairs, [P] each."""
        parts = zip(self._geoms, self._halves, self._radii, strict=True)
        one, other = (Capsule(geom_xpos[g], geom_xmat[g][:, :, 2], half, radius) for g, half, radius in parts)
        return one, other

    def overflow(self, closest: Closest) -> Array:
        """Return how many overlapping pairs `deepest` leaves out, []."""
        if self.count <= SLOTS:
            return jnp.int32(0)
        count = jnp.sum(closest.distance < 0, dtype=jnp.float32)  # the fused engine looks for bounds of whole numbers
        return jnp.maximum(count - SLOTS, 0.0).astype(jnp.int32)

    def deepest(self, data: Any, closest: Closest) -> Touching:
        """Return the contacts of the deepest pairs, at most `SLOTS` of them.

        `data` is MJX's data, with `cdof` and `subtree_com`. The Jacobian of a pair that does not overlap is zero.
        """
        distance, pair = jax.lax.top_k(-closest.distance, min(SLOTS, self.count))
        point, normal = closest.point[pair], closest.normal[pair]
        offset = point[:, None] - data.subtree_com[self._roots]
        velocity = data.cdof[:, 3:] + jnp.cross(data.cdof[:, :3], offset)
        jacobian = jnp.asarray(self._sign)[pair] * jnp.sum(velocity * normal[:, None], -1)
        touching = distance > 0
        return Touching(pair, -distance, jacobian * touching[:, None], jnp.asarray(self._weight)[pair])


def moved_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies each joint moves, [nbody, nv]."""
    moved = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first, count = model.body_dofadr[body], model.body_dofnum[body]
        moved[body, first : first + count] = 1
    return moved
