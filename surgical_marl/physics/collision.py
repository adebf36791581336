"""Distance and contact of capsules in pure JAX, for the pairs of geoms of a scene that can touch.

All collision geoms are capsules or spheres, so that a pair is two line segments with a radius each: their distance is
exact, and the same as C MuJoCo's. A physics step asks first whether anything touches (`overlap`). Few pairs touch
at a time: only the `SLOTS` deepest become constraint rows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.physics.tiles import Tiles
from surgical_marl.scenes.geometry import Capsule, axis_gap

SLOTS = 6
"""Contacts at one time. Arms driven at random with full effort in all six scenes had 4 at most, in 144,000 steps."""


AT_ONCE = 128
"""Pairs up to which all are looked at side by side. If there are more, a loop over pairs of arms keeps the fused
engine's code as short for six arms as for two."""
BLOCK = 36
"""Pairs among which the deepest are found at a time, if there are more than `AT_ONCE`."""


APART = 1e-5
"""Distance of two groups of capsules from which on no rounding error lets them overlap, m."""


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
        self._half = np.where(model.geom_type == capsule, model.geom_size[:, 1], 0).astype(single)
        self._radius = model.geom_size[:, 0].astype(single)
        self.tiles = Tiles(model, *self._geoms) if self.count > AT_ONCE else None
        bodies = [model.geom_bodyid[geoms] for geoms in self._geoms]
        self._weight = sum(model.body_invweight0[body, 0] for body in bodies).astype(single)
        moved = moved_bodies(model)
        self._blocks = np.minimum(np.arange(-(-self.count // BLOCK) * BLOCK), self.count - 1).reshape(-1, BLOCK)
        self._sign = (moved[bodies[1]] - moved[bodies[0]]).astype(single)
        self._roots = model.body_rootid[model.dof_bodyid]
        trees = np.sort([model.body_rootid[body] for body in bodies], 0)
        self._trees = model.body_rootid[model.geom_bodyid]
        self._groups = {tuple(both): np.flatnonzero((both == trees.T).all(1)) for both in np.unique(trees, axis=1).T}
        """Pairs by the two arms that they are between."""

    def overlap(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return whether any pair overlaps, []: for less than what `distance` costs."""

        def least(one: Capsule, other: Capsule, is_pair: Any) -> Array:
            gap, reach = axis_gap(one, other)[1], one.radius + other.radius
            return jnp.min(jnp.where(is_pair, jnp.sum(gap * gap, -1) - reach * reach, np.inf), initial=np.inf)

        if self.tiles is not None:
            return jnp.min(self._each(least, geom_xpos, geom_xmat)) < 0
        found = jnp.bool_(False)  # also if there are no pairs
        for arms, pairs in self._groups.items():
            ends = [self._capsules(of[pairs], geom_xpos, geom_xmat) for of in self._geoms]
            exact = lambda one, other: least(one, other, np.bool_(True)) < 0  # noqa: E731
            geoms = np.unique([of[pairs] for of in self._geoms])
            if arms[0] == arms[1] or len(pairs) < len(geoms):
                found |= exact(*ends)
                continue
            sides = (self._capsules(geoms[self._trees[geoms] == arm], geom_xpos, geom_xmat) for arm in arms)
            found |= jax.lax.cond(_apart(*sides), lambda *_: jnp.bool_(False), exact, *ends)
        return found

    def distance(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return the signed distance of every pair, m, [P]; negative where they overlap."""
        return self.closest(geom_xpos, geom_xmat).distance

    def closest(self, geom_xpos: Array, geom_xmat: Array) -> Closest:
        """Return where the pairs are closest, from positions [ngeom, 3] and frames [ngeom, 3, 3] of all geoms."""
        found: Closest = self._each(_closest, geom_xpos, geom_xmat)
        if self.tiles is None:
            return found
        place = self.tiles.place
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:])[place], found)

    def _each(self, of: Callable[[Capsule, Capsule, Any], Any], geom_xpos: Array, geom_xmat: Array) -> Any:
        """Return what a function makes of the capsules of all pairs.

        It is called with both capsules of all pairs, [P], and True; or, if there are many, as `Tiles.each` does.
        """
        if self.tiles is None:
            one, other = (self._capsules(geoms, geom_xpos, geom_xmat) for geoms in self._geoms)
            return of(one, other, np.bool_(True))
        return self.tiles.each(of, self._capsules(self.tiles.geoms, geom_xpos, geom_xmat))

    def _capsules(self, geoms: np.ndarray, geom_xpos: Array, geom_xmat: Array) -> Capsule:
        """Return the capsules of some geoms."""
        return Capsule(geom_xpos[geoms], geom_xmat[geoms][:, :, 2], self._half[geoms], self._radius[geoms])

    def overflow(self, closest: Closest) -> Array:
        """Return how many overlapping pairs `deepest` leaves out, []."""
        if self.count <= SLOTS:
            return jnp.int32(0)
        count = jnp.sum(closest.distance < 0, dtype=jnp.float32)  # the fused engine looks for bounds of whole numbers
        return jnp.maximum(count - SLOTS, 0.0).astype(jnp.int32)

    def deepest(self, data: Any, closest: Closest) -> Touching:
        """Return the contacts of the deepest pairs, at most `SLOTS` of them.

        `data` is MJX's data, with the poses of geoms, `cdof` and `subtree_com`. The Jacobian of a pair that does not
        overlap is zero.
        """
        distance, pair = self._top(-closest.distance)
        if self.tiles is None:
            point, normal = closest.point[pair], closest.normal[pair]
        else:  # computed again: the fused engine would look for each number among those of all pairs
            known = self._capsules(self.tiles.geoms, data.geom_xpos, data.geom_xmat)
            _, point, normal = _closest(*self.tiles.ends_of(pair, known), np.bool_(True))
        offset = point[:, None] - data.subtree_com[self._roots]
        velocity = data.cdof[:, 3:] + jnp.cross(data.cdof[:, :3], offset)
        jacobian = jnp.asarray(self._sign)[pair] * jnp.sum(velocity * normal[:, None], -1)
        touching = distance > 0
        return Touching(pair, -distance, jacobian * touching[:, None], jnp.asarray(self._weight)[pair])

    def _top(self, depth: Array) -> tuple[Array, Array]:
        """Return the `SLOTS` largest of all pairs' depths [P], and which pairs these are."""
        if self.tiles is None:
            return jax.lax.top_k(depth, min(SLOTS, self.count))
        padded = jnp.where(np.arange(self._blocks.size) < self.count, depth[self._blocks.ravel()], -np.inf)
        found, place = jax.lax.map(lambda rows: jax.lax.top_k(rows, SLOTS), padded.reshape(-1, BLOCK))
        pairs = place + BLOCK * np.arange(len(found))[:, None]
        best, which = jax.lax.top_k(found.ravel(), SLOTS)
        return best, pairs.ravel()[which]

    def spread(self, pair: Array, values: Array) -> Array:
        """Return the sum of values [K] of each pair, [P], which they are of by its number [K]; 0 for all others."""
        if self.tiles is None:
            return jnp.where(pair == np.arange(self.count)[:, None], values, 0.0).sum(-1)
        return jnp.zeros(self.count, values.dtype).at[pair].add(values)


def _apart(one: Capsule, other: Capsule) -> Array:
    """Return whether a plane is between two groups of capsules, across the way from the first to the first, []."""
    way = other.centre[0] - one.centre[0]
    length = jnp.sqrt(jnp.sum(way * way))

    def reach(capsules: Capsule) -> tuple[Array, Array]:
        middle, half = capsules.centre @ way, jnp.abs(capsules.axis @ way) * capsules.half + capsules.radius * length
        return jnp.min(middle - half), jnp.max(middle + half)

    return reach(other)[0] - reach(one)[1] > APART * length


def _closest(one: Capsule, other: Capsule, is_pair: Any) -> Closest:
    """Return where pairs of capsules are closest."""
    where, gap = axis_gap(one, other)
    length = jnp.sqrt(jnp.maximum(jnp.sum(gap * gap, -1), 1e-18))
    normal = gap / length[..., None]
    distance = length - (one.radius + other.radius)
    segment = one.segment()
    point = segment.start + where[..., None] * segment.extent + (one.radius + distance / 2)[..., None] * normal
    return Closest(distance, point, normal)


def moved_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Which bodies each joint moves, [nbody, nv]."""
    moved = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first, count = model.body_dofadr[body], model.body_dofnum[body]
        moved[body, first : first + count] = 1
    return moved
