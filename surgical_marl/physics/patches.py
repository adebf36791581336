"""Where objects are touched: patches, each between two bodies, of a few points and one friction.

The points of a patch are the support of the contact: of all points at which the shapes of two bodies touch, the deepest
one and the outermost ones in three directions. A patch has one friction, with a bound by the sum of its normal forces:
a force along the surface and a torque about the normal, bounded together by an ellipsoid (R. D. Howe and M. R.
Cutkosky, "Practical force-motion models for sliding manipulation", 1996).
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.physics.shapes import Points

SLOTS = 4
"""Points of a patch."""
AWAY = -100.0
"""Depth, m, of a point that is not there: no scene is so large."""
_OUTWARD = np.array([[0.0, 1.0], [-0.866, -0.5], [0.866, -0.5]], np.float32)


class Patch(NamedTuple):
    """A contact of two bodies, [...]."""

    points: Points
    """[..., SLOTS]"""
    centre: Array
    """Where friction acts: the mean of the points, weighted by depth, [..., 3]."""
    frame: Array
    """Rows: the normal and two directions along the surface, [..., 3, 3]."""
    radius: Array
    """Torque about the normal that counts as much as a force of 1 N along the surface, m, [...]."""


def find_patch(points: Points, soon: Array, axes: Array, torsion: Array) -> Patch:
    """Return the patch of a pair of bodies.

    Args:
        points: all points [c] at which their shapes may touch.
        soon: their depths after a step with the velocities of now, [c]. The support is chosen by these, so that no part
            of a fast object comes in unseen.
        axes: two directions, [2, 3]; the outermost points are looked for in their plane.
        torsion: radius of the contact at a point, m, [].
    """
    touches = jnp.maximum(points.depth, soon) > 0
    outward = jnp.matmul(points.place, axes.T) @ jnp.asarray(_OUTWARD).T  # [c, 3]
    rim = jnp.where(touches[:, None], outward, points.depth[:, None] + AWAY)
    best = jnp.argmax(jnp.concatenate([jnp.maximum(points.depth, soon)[:, None], rim], 1), 0)
    again = np.tri(SLOTS, k=-1, dtype=bool)
    twice = ((best[:, None] == best[None, :]) & again).any(1)
    depth = jnp.where(twice, AWAY, points.depth[best])
    chosen = Points(depth, points.place[best], points.normal[best])
    return _with_frame(chosen, torsion)


def _with_frame(points: Points, torsion: Array) -> Patch:
    pressed = jnp.maximum(points.depth, 1e-9)
    deepest = jnp.argmax(points.depth)
    weight = jnp.where(points.depth > AWAY, pressed, 0.0)
    weight = weight / jnp.maximum(jnp.sum(weight), 1e-12)
    centre = weight @ points.place
    normal = points.normal[deepest]
    spread = jnp.sqrt(jnp.maximum(weight @ jnp.sum((points.place - centre) ** 2, -1), 1e-18))
    return Patch(points, centre, tangents(normal), torsion + spread)


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
    points = Points(jnp.full(SLOTS, AWAY), jnp.zeros((SLOTS, 3)), jnp.zeros((SLOTS, 3)))
    return Patch(points, none, jnp.zeros((3, 3)), jnp.float32(1.0))
