"""Distance and contact of capsules in pure JAX, for the pairs of geoms of a scene that can touch.

All collision geoms are capsules or spheres, so that a pair is two line segments with a radius each: their distance is
exact, and the same as C MuJoCo's. A physics step asks first whether anything touches (`overlap`). Few pairs touch
at a time: only the `SLOTS` deepest become constraint rows.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from surgical_marl.physics import skip
from surgical_marl.physics.contact.arm_pairs import Tiles
from surgical_marl.scenes.geometry import Capsule, axis_gap

SLOTS = 6
"""Contacts at one time. Arms driven at random with full effort in all six scenes had 4 at most, in 144,000 steps."""


AT_ONCE = 128
"""Pairs up to which all are looked at side by side while arms touch nothing, which is quicker than a loop. If there are
more, a loop over pairs of arms keeps the fused engine's code as short for six arms as for two."""
BLOCK = 12
"""Pairs among which the deepest are found at a time."""


APART = 1e-5
"""Distance of two groups of capsules from which on no rounding error lets them overlap, m."""


class Closest(NamedTuple):
    """Closest points of the two geoms of pairs, [...]."""

    distance: Array
    """Signed, m: negative where they overlap."""
    point: Array
    """Midway between the two surfaces, in the world, [..., 3]."""
    normal: Array
    """Unit vector from the first geom to the second, [..., 3]."""


class Touching(NamedTuple):
    """The deepest contacts, [K] each."""

    pair: Array
    """Number of the pair."""
    distance: Array
    jacobian: Array
    """Speed along the normal by joint velocity, [K, nv]; zero where nothing touches."""
    weight: Array
    """Inverse mass of the two bodies, 1/kg."""
    left_out: Array
    """Number of other pairs that overlap, []."""


class Pairs:
    """The pairs of a model (`<pair>` elements between capsules and spheres)."""

    def __init__(self, model: mujoco.MjModel) -> None:
        single = np.float32
        self.count = model.npair
        self._geoms = model.pair_geom1.copy(), model.pair_geom2.copy()
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        self._half = np.where(model.geom_type == capsule, model.geom_size[:, 1], 0).astype(single)
        self._radius = model.geom_size[:, 0].astype(single)
        self._model, self._at_once = model, self.count <= AT_ONCE
        bodies = [model.geom_bodyid[geoms] for geoms in self._geoms]
        self._weight = sum(model.body_invweight0[body, 0] for body in bodies).astype(single)
        moved = moved_bodies(model)
        self._sign = (moved[bodies[1]] - moved[bodies[0]]).astype(single)
        self._roots = model.body_rootid[model.dof_bodyid]
        trees = np.sort([model.body_rootid[body] for body in bodies], 0)
        self._trees = model.body_rootid[model.geom_bodyid]
        self._groups = {tuple(both): np.flatnonzero((both == trees.T).all(1)) for both in np.unique(trees, axis=1).T}
        """Pairs by the two arms that they are between."""

    @cached_property
    def _tiles(self) -> Tiles:
        return Tiles(self._model, *self._geoms)

    def overlap(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return whether any pair overlaps, []; cheaper than `distance`."""

        def least(one: Capsule, other: Capsule, is_pair: Any) -> Array:
            gap, reach = axis_gap(one, other)[1], one.radius + other.radius
            return jnp.min(jnp.where(is_pair, jnp.sum(gap * gap, -1) - reach * reach, np.inf), initial=np.inf)

        def exact(one: Capsule, other: Capsule) -> Array:
            return least(one, other, np.bool_(True)) < 0

        if not self._at_once:
            return jnp.min(self._by_arms(least, geom_xpos, geom_xmat)) < 0
        found = jnp.bool_(False)  # also if there are no pairs
        for arms, pairs in self._groups.items():
            ends = [self._capsules(of[pairs], geom_xpos, geom_xmat) for of in self._geoms]
            geoms = np.unique([of[pairs] for of in self._geoms])
            if arms[0] == arms[1] or len(pairs) < len(geoms):
                found |= exact(*ends)
                continue
            sides = (self._capsules(geoms[self._trees[geoms] == arm], geom_xpos, geom_xmat) for arm in arms)
            found |= skip.cond("arm_planes", ~_apart(*sides), exact, lambda *_: jnp.bool_(False), *ends)
        return found

    def distance(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return the signed distance of every pair, m, [P]; negative where they overlap.

        They are computed from positions [ngeom, 3] and frames [ngeom, 3, 3] of all geoms.
        """
        if not self._at_once:
            return self.distance_by_arms(geom_xpos, geom_xmat)
        return _closest(*(self._capsules(geoms, geom_xpos, geom_xmat) for geoms in self._geoms)).distance

    def distance_by_arms(self, geom_xpos: Array, geom_xmat: Array) -> Array:
        """Return what `distance` does, computed in a loop over pairs of arms: shorter code, but slower on a GPU."""
        found = self._by_arms(lambda one, other, _: _closest(one, other).distance, geom_xpos, geom_xmat)
        return found.ravel()[self._tiles.place]

    def closest(self, geom_xpos: Array, geom_xmat: Array, pair: Array) -> Closest:
        """Return where some pairs are closest, by their numbers [...], from poses of geoms as in `distance`."""
        return _closest(*self._tiles.ends_of(pair, self._capsules(self._tiles.geoms, geom_xpos, geom_xmat)))

    def _by_arms(self, of: Callable[[Capsule, Capsule, Any], Any], geom_xpos: Array, geom_xmat: Array) -> Any:
        """Return a function's results for the capsules of all pairs of arms, as `Tiles.each` does."""
        return self._tiles.each(of, self._capsules(self._tiles.geoms, geom_xpos, geom_xmat))

    def _capsules(self, geoms: np.ndarray, geom_xpos: Array, geom_xmat: Array) -> Capsule:
        """Return the capsules of some geoms."""
        return Capsule(geom_xpos[geoms], geom_xmat[geoms][:, :, 2], self._half[geoms], self._radius[geoms])

    def deepest(self, data: Any, distance: Array) -> Touching:
        """Return the contacts of the deepest pairs, at most `SLOTS` of them, by the distances of all [P].

        `data` is MJX's data, with the poses of geoms, `cdof` and `subtree_com`. The Jacobian of a pair that does not
        overlap is zero.
        """
        depth, pair, left_out = self._top(-distance)

        def parting(row: tuple[Array, Array]) -> Array:
            depth, pair = row

            def speeds() -> Array:
                where = self.closest(data.geom_xpos, data.geom_xmat, pair)
                velocity = data.cdof[:, 3:] + jnp.cross(data.cdof[:, :3], where.point - data.subtree_com[self._roots])
                return jnp.asarray(self._sign)[pair] * (velocity @ where.normal)

            return jax.lax.cond(depth > 0, speeds, lambda: jnp.zeros(len(self._roots)))

        return Touching(pair, -depth, jax.lax.map(parting, (depth, pair)), jnp.asarray(self._weight)[pair], left_out)

    def _top(self, depth: Array) -> tuple[Array, Array, Array]:
        """Return the `SLOTS` largest of all pairs' depths [P], which pairs these are, and how many more overlap."""
        slots = min(SLOTS, self.count)
        blocks = jnp.pad(depth, (0, -len(depth) % BLOCK), constant_values=-np.inf).reshape(-1, BLOCK)

        def best(found: Any, block: tuple[Array, Array]) -> tuple[Any, None]:
            depth, pair = (jnp.concatenate(both) for both in zip(found[:2], block, strict=True))
            depth, place = jax.lax.top_k(depth, slots)
            # a sum of real numbers: the fused engine looks for bounds of whole ones
            return (depth, pair[place], found[2] + jnp.sum(block[0] > 0, dtype=jnp.float32)), None

        none = jnp.full(slots, -np.inf), jnp.zeros(slots, jnp.int32), jnp.float32(-slots)
        numbers = jnp.arange(blocks.size, dtype=jnp.int32).reshape(blocks.shape)
        (depth, pair, more), _ = jax.lax.scan(best, none, (blocks, numbers))
        return depth, pair, jnp.maximum(more, 0.0).astype(jnp.int32)

    def spread(self, pair: Array, values: Array) -> Array:
        """Return the sum [P] of the values [K] that belong to each pair, by the pairs' numbers [K]; 0 without any."""
        if self._at_once:  # in registers of a GPU
            return jnp.where(pair == np.arange(self.count)[:, None], values, 0.0).sum(-1)
        return jnp.zeros(self.count, values.dtype).at[pair].add(values)


def _apart(one: Capsule, other: Capsule) -> Array:
    """Return whether a plane separates two groups of capsules, normal to the line between the first of each, []."""
    axis = other.centre[0] - one.centre[0]
    length = jnp.sqrt(jnp.sum(axis * axis))

    def reach(capsules: Capsule) -> tuple[Array, Array]:
        middle, half = capsules.centre @ axis, jnp.abs(capsules.axis @ axis) * capsules.half + capsules.radius * length
        return jnp.min(middle - half), jnp.max(middle + half)

    return reach(other)[0] - reach(one)[1] > APART * length


def _closest(one: Capsule, other: Capsule) -> Closest:
    """Return where pairs of capsules are closest."""
    where, gap = axis_gap(one, other)
    length = jnp.sqrt(jnp.maximum(jnp.sum(gap * gap, -1), 1e-18))
    normal = gap / length[..., None]
    distance = length - (one.radius + other.radius)
    segment = one.segment()
    point = segment.start + where[..., None] * segment.extent + (one.radius + distance / 2)[..., None] * normal
    return Closest(distance, point, normal)


def moved_bodies(model: mujoco.MjModel) -> np.ndarray:
    """Return which bodies each joint moves, [nbody, nv], 1 or 0."""
    moved = np.zeros((model.nbody, model.nv))
    for body in range(1, model.nbody):
        moved[body] = moved[model.body_parentid[body]]
        first, count = model.body_dofadr[body], model.body_dofnum[body]
        moved[body, first : first + count] = 1
    return moved
