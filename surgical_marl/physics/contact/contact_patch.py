"""Patches: contacts between two bodies, of a few points and one friction each.

The points of a patch are the support of the contact: of all points at which the shapes of two bodies may touch, those
that are deepest as the bodies are, and if one of them were tilted a little in each of three directions. Points that are
equally deep are averaged. So points move as the bodies move; none appears or vanishes from one step to the next.

A patch has one friction, with a bound by the sum of its normal forces: a force along the surface and a torque about the
normal, bounded together by an ellipsoid (R. D. Howe and M. R. Cutkosky, "Practical force-motion models for sliding
manipulation", 1996).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.contact.shapes import Points
from surgical_marl.physics.tree_utils import put, room, row_of

POINTS = 4
"""Points of a patch."""
AWAY = -100.0
"""Depth, m, of a point that is not there: no scene is so large."""
TILT = 0.03
"""Tilt of a body to find the rim of a contact, rad. A wider rim may leave out what carries an object that
lies on a blunt edge, for what comes down only if it turns further: it would rock there for ever."""
TILT_IN_JAW = 0.1
"""Tilt between fingers, rad. A firm grip dents a wire that is bent to a radius of 8 mm over 0.7 mm to
each side, where its direction differs by 0.08 rad. With a narrower rim nothing in a patch would stop the wire from
turning while the jaw closes, and it would be thrown about."""
LEAN = 0.005
"""Tilt of a body to find its deepest point, rad, if three points of the rim do not bear its weight: to the
side on which they don't. Those of a half circle that lies flat do not in most directions, and without this it would
rock on them for ever."""
ASIDE = 1e-3
"""Distance of the weight beyond them where this tilt is whole, m, and within them where there is none."""
SHORT = 1e-4
"""Two points of the rim that are nearer than this count less as an edge, m."""
BLEND = 1e-5
"""Difference in depth over which the place of a point goes from one of two candidates to the other, m: a quarter of the
overlap of a firm grip."""
ALIKE = 1e-4
"""Depth beyond which points of the rim are not told apart, m: of all points that a fast object brings in within a step
it takes the outermost."""
_TILTS = np.array([[1.0, 0.0], [-0.5, 0.866], [-0.5, -0.866]], np.float32)


class Patch(NamedTuple):
    """A contact of two bodies, [...]."""

    points: Points
    """[..., POINTS]"""
    centre: Array
    """Place where friction acts: the mean of the points, weighted by depth, [..., 3]."""
    normal: Array
    """[..., 3]"""
    radius: Array
    """Torque about the normal that counts as much as a force of 1 N along the surface, m, [...]."""
    reach: Array
    """Depth of the deepest point now or after the step, m, [...]."""

    @property
    def frame(self) -> Array:
        """Rows: the normal and two directions along the surface, [..., 3, 3]."""
        return tangents(self.normal)


def find_patch(
    look: Callable[[Array], tuple[Points, Array]], count: Any, rows: int, middle: Array, axes: Array, tilt: float,
    torsion: Array, centre: Array | None = None,
) -> Patch:  # fmt: skip
    """Return the patch of a pair of bodies.

    Args:
        look: takes the number of a shape; returns all points at which it may touch, [d], and their depths after a step
            at the present velocities, [d]. A point counts by the larger of both depths, so that no part of a fast
            object comes in unseen.
        count: how many shapes there are, []; without any, the patch is nothing.
        rows: how many there may be.
        middle: a place near the points, from which they are measured, [3].
        axes: two directions along the surface, [2, 3]; a tilt adds depth along a mix of them.
        tilt: by how much, rad.
        torsion: radius of the contact at a point, m, [].
        centre: where the weight of one of the bodies acts, [3]. The deepest point is then looked for under a slight
            tilt of this body if the other three do not bear its weight. None: under no tilt.
    """
    rims = _Tilts(tilt * jnp.asarray(_TILTS) @ axes, np.full(len(_TILTS), ALIKE, np.float32), middle)
    if centre is None:
        tilts = _Tilts(jnp.pad(rims.by, ((1, 0), (0, 0))), np.append(np.float32(-AWAY), rims.limits), middle)
        points, most, reach = _seen(look, count, rows, tilts)
        return _patch(_supports(points, count, tilts, most), torsion, reach)
    points, most, reach = _seen(look, count, rows, rims)
    rim = _supports(points, count, rims, most)
    lean = LEAN * _beyond(axes @ centre, rim.place @ axes.T) @ axes
    leant = _Tilts(lean[None], np.full(1, -AWAY, np.float32), middle)

    def deeper(n: Array, most: Array) -> Array:
        return jnp.maximum(most, leant.deepest(*row_of(points, n)))

    deepest = _supports(points, count, leant, jax.lax.fori_loop(0, count, deeper, jnp.full(1, 2 * AWAY)))
    chosen = Points(*(jnp.concatenate(parts) for parts in zip(deepest, rim, strict=True)))
    return _patch(chosen, torsion, reach)


class _Tilts(NamedTuple):
    """Tilts of one of two bodies, p of them, under which the deepest point is looked for."""

    by: Array
    """Gradient of the added depth by place: a place gains `by @ (place - middle)`, [p, 3]."""
    limits: Any
    """Largest depths that are told apart: deeper points count as these, m, [p]."""
    middle: Array
    """[3]"""

    def depths(self, points: Points, soon: Array) -> Array:
        """Return the depths of points [d], tilted, [d, p]."""
        depth = jnp.minimum(jnp.maximum(points.depth, soon)[:, None], self.limits)
        return depth + (points.place - self.middle) @ self.by.T

    def deepest(self, points: Points, soon: Array) -> Array:
        """Return the largest of these depths, m, [p]."""
        return jnp.max(self.depths(points, soon), 0)


def _seen(
    look: Callable[[Array], tuple[Points, Array]], count: Any, rows: int, tilts: _Tilts
) -> tuple[tuple[Points, Array], Array, Array]:
    """Return all points, the largest depth under each tilt, m, [p], and without any, m, []."""

    def see(n: Array, state: Any) -> Any:
        kept, most, reach = state
        one = look(n)
        kept = put(kept, n, one)
        return (
            kept,
            jnp.maximum(most, tilts.deepest(*one)),
            jnp.maximum(reach, jnp.max(jnp.maximum(one[0].depth, one[1]))),
        )

    kept = room(jax.eval_shape(lambda: look(jnp.int32(0))), rows)
    start = kept, jnp.full(len(tilts.by), 2 * AWAY), jnp.float32(2 * AWAY)
    found: tuple[tuple[Points, Array], Array, Array] = jax.lax.fori_loop(0, count, see, start)
    return found


def _beyond(point: Array, corners: Array) -> Array:
    """Return the outward direction in which a point [2] lies beyond a triangle, [2]: 0 well within, length 1 outside.

    The corners [3, 2] go around counterclockwise.
    """
    along = jnp.roll(corners, -1, 0) - corners
    out = jnp.stack([along[:, 1], -along[:, 0]], 1)
    out = out / jnp.sqrt(jnp.sum(out * out, 1, keepdims=True) + SHORT**2)
    beyond = jnp.sum(out * (point - corners), 1)
    return jnp.clip((1 + beyond / ASIDE) / 2, 0.0, 1.0) @ out


def _supports(points: tuple[Points, Array], count: Any, tilts: _Tilts, most: Array) -> Points:
    """Return the points that are deepest under p tilts, [p], from all points and the largest depths under each, [p]."""

    def add(n: Array, total: tuple[Array, Points]) -> tuple[Array, Points]:
        one, then = row_of(points, n)
        weight = jnp.maximum(tilts.depths(one, then) - most + BLEND, 0.0).T  # [p, d]
        own = Points(weight @ one.depth, weight @ (one.place - tilts.middle), weight @ one.normal)
        return total[0] + jnp.sum(weight, 1), jax.tree.map(jnp.add, total[1], own)

    zeros = jnp.zeros((len(most), 3))
    weight, found = jax.lax.fori_loop(0, count, add, (zeros[:, 0], Points(zeros[:, 0], zeros, zeros)))
    place, normal = found.place / weight[:, None], found.normal / weight[:, None]
    return Points(found.depth / weight, tilts.middle + place, _unit(normal))


def _patch(points: Points, torsion: Array, reach: Array) -> Patch:
    """Return the patch of points. The first of them decides where bodies press from opposite sides, as in a fork."""
    weight = jnp.maximum(points.depth, 1e-9)
    weight = weight / jnp.sum(weight)
    centre = weight @ points.place
    spread = weight @ jnp.sum((points.place - centre) ** 2, -1)
    normal = _unit(weight @ points.normal + 1e-3 * points.normal[0])
    # As a patch turns, a point at a distance r slides and turns in place: that takes mu N hypot(r, torsion) a radian.
    return Patch(points, centre, normal, jnp.sqrt(jnp.maximum(torsion * torsion + spread, 1e-18)), reach)


def _unit(vector: Array) -> Array:
    return vector / jnp.sqrt(jnp.maximum(jnp.sum(vector * vector, -1, keepdims=True), 1e-12))


def tangents(normal: Array) -> Array:
    """Return frames [..., 3, 3] whose rows are unit vectors [..., 3] and two directions across them."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    sign = jnp.where(z < 0, -1.0, 1.0)  # T. Duff et al., "Building an orthonormal basis, revisited", 2017
    a = -1.0 / (sign + z)
    b = x * y * a
    one = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    other = jnp.stack([b, sign + y * y * a, -y], -1)
    return jnp.stack([normal, one, other], -2)


def no_patch() -> Patch:
    """Return a patch that is not there."""
    none = jnp.zeros(3)
    points = Points(jnp.full(POINTS, AWAY), jnp.zeros((POINTS, 3)), jnp.zeros((POINTS, 3)))
    return Patch(points, none, none, jnp.float32(1.0), jnp.float32(AWAY))
