"""Where objects are touched: patches, each between two bodies, of a few points and one friction.

The points of a patch are the support of the contact: of all points at which the shapes of two bodies may touch, those
that are deepest as the bodies are, and if one of them were tilted a little in each of three directions. Points that are
equally deep are averaged. So points move as the bodies move; none appears or vanishes from one step to the next.

A patch has one friction, with a bound by the sum of its normal forces: a force along the surface and a torque about the
normal, bounded together by an ellipsoid (R. D. Howe and M. R. Cutkosky, "Practical force-motion models for sliding
manipulation", 1996).
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
TILT = 0.03
"""By which a body is tilted to find the rim of a contact, rad: about the angle by which an object in a firm grip can
rock."""
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
        soon: their depths after a step with the velocities of now, [c]. A point counts by the larger one of both
            depths, so that no part of a fast object comes in unseen.
        axes: two directions, [2, 3]: bodies are tilted about those across them.
        torsion: radius of the contact at a point, m, [].
    """
    reach = jnp.maximum(points.depth, soon)
    middle = jnp.mean(points.place, 0)
    rim = jnp.minimum(reach, ALIKE)[:, None] + TILT * ((points.place - middle) @ axes.T @ jnp.asarray(_TILTS).T)
    tilted = jnp.concatenate([reach[:, None], rim], 1)  # [c, SLOTS]
    weight = jnp.maximum(tilted - jnp.max(tilted, 0) + BLEND, 0.0)
    weight = (weight / jnp.sum(weight, 0)).T
    chosen = Points(weight @ points.depth, middle + weight @ (points.place - middle), _unit(weight @ points.normal))
    return _with_frame(chosen, torsion)


def _with_frame(points: Points, torsion: Array) -> Patch:
    weight = jnp.maximum(points.depth, 1e-9)
    weight = weight / jnp.sum(weight)
    centre = weight @ points.place
    spread = jnp.sqrt(jnp.maximum(weight @ jnp.sum((points.place - centre) ** 2, -1), 1e-18))
    # The first point decides where bodies press from opposite sides, as in a fork.
    normal = _unit(weight @ points.normal + 1e-3 * points.normal[0])
    return Patch(points, centre, tangents(normal), torsion + spread)


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
