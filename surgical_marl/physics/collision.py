"""Distance and contact of capsules in pure JAX, for the pairs of geoms of a scene that can touch.

All collision geoms are capsules or spheres, so that a pair is two line segments with a radius each: their distance is
exact, and the same as C MuJoCo's. Few pairs touch at a time: only the `SLOTS` deepest become constraint rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

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
        self._half = [
            np.where(model.geom_type[g] == capsule, model.geom_size[g, 1], 0).astype(single) for g in self._geoms
        ]
        self._first_radius, second = (model.geom_size[g, 0].astype(single) for g in self._geoms)
        self._radii = self._first_radius + second
        bodies = [model.geom_bodyid[geoms] for geoms in self._geoms]
        self._weight = sum(model.body_invweight0[body, 0] for body in bodies).astype(single)
        moved = _moved_bodies(model)
        self._sign = (moved[bodies[1]] - moved[bodies[0]]).astype(single)
        self._roots = model.body_rootid[model.dof_bodyid]

    def closest(self, geom_xpos: Array, geom_xmat: Array) -> Closest:
        """From positions [ngeom, 3] and frames [ngeom, 3, 3] of all geoms: Ericson, "Real-time collision detection",
        2005, section 5.1.9."""
        one, other = (geom_xpos[geoms] for geoms in self._geoms)
        along, across = (geom_xmat[geoms][:, :, 2] for geoms in self._geoms)
        half, reach = self._half
        between = one - other
        b, d, e = (jnp.sum(x * y, -1) for x, y in ((along, across), (along, between), (across, between)))
        # segments one + s along, other + t across; parallel ones may start anywhere
        s = jnp.clip((b * e - d) / jnp.maximum(1 - b * b, 1e-6), -half, half)
        t = jnp.clip(e + b * s, -reach, reach)
        s = jnp.clip(b * t - d, -half, half)
        way = t[:, None] * across - s[:, None] * along - between
        length = jnp.sqrt(jnp.maximum(jnp.sum(way * way, -1), 1e-18))
        normal = way / length[:, None]
        distance = length - self._radii
        middle = one + s[:, None] * along + (self._first_radius + distance / 2)[:, None] * normal
        return Closest(distance, middle, normal)

    def deepest(self, data: Any, closest: Closest) -> Touching:
        """The contacts that matter. `data` is MJX's, with `cdof` and `subtree_com`."""
        distance, pair = jax.lax.top_k(-closest.distance, min(SLOTS, self.count))
        point, normal = closest.point[pair], closest.normal[pair]
        offset = point[:, None] - data.subtree_com[self._roots]
        velocity = data.cdof[:, 3:] + jnp.cross(data.cdof[:, :3], offset)
        jacobian = jnp.asarray(self._sign)[pair] * jnp.sum(velocity * normal[:, None], -1)
        touching = distance > 0
        return Touching(pair, -distance, jacobian * touching[:, None], jnp.asarray(self._weight)[pair])


def _moved_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies each joint moves, [nbody, nv]."""
    moved = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first, count = model.body_dofadr[body], model.body_dofnum[body]
        moved[body, first : first + count] = 1
    return moved
