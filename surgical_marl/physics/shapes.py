"""Where shapes of objects touch those of arms and of other objects: points, depths and normals, in pure JAX.

Every shape is a core with a radius: a point (sphere), a segment (capsule) or a rectangle (plate). A plate stands for a
box: its core is the box's middle rectangle, its radius half of the thinnest side, so its faces are flat and its edges
round. The overlap of two shapes is the sum of their radii less the distance of their cores. This is exact as long as
the cores do not meet.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array


class Segments(NamedTuple):
    """Capsules and spheres; a sphere's two ends are one point. Batches [...]."""

    start: Array
    """World, m, [..., 3]."""
    end: Array
    radius: Any
    """m, [...]."""


class Plate(NamedTuple):
    """A rectangle with a radius. Batches [...]."""

    centre: Array
    """World, m, [..., 3]."""
    frame: Array
    """Columns: the two directions of the sides and the normal of the faces, [..., 3, 3]."""
    half: Any
    """Half sides of the core, m, [..., 2]."""
    radius: Any
    """m, [...]."""


class Points(NamedTuple):
    """Points at which a first shape and a second one are nearest, [...]."""

    depth: Array
    """Overlap, m; negative for a distance."""
    place: Array
    """Midway between the two surfaces, world, m, [..., 3]."""
    normal: Array
    """Unit vector from the second shape to the first, [..., 3]."""


def between_segments(one: Segments, other: Segments) -> Points:
    """Return the nearest points of capsules, [...].

    C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.9.
    """
    d1, d2, r = one.end - one.start, other.end - other.start, one.start - other.start
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    c, f = _dot(d1, r), _dot(d2, r)
    tiny = 1e-12  # of a sphere; lengths below 1 um
    crossing = jnp.maximum(a * e - b * b, 1e-6 * a * e + tiny**2)  # parallel: any point will do
    s = jnp.clip((b * f - c * e) / crossing, 0.0, 1.0)
    t = jnp.clip((b * s + f) / jnp.maximum(e, tiny), 0.0, 1.0)
    s = jnp.clip((b * t - c) / jnp.maximum(a, tiny), 0.0, 1.0)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    length = jnp.sqrt(jnp.maximum(_dot(gap, gap), 1e-18))
    normal = gap / length[..., None]
    depth = one.radius + other.radius - length
    place = one.start + s[..., None] * d1 - (one.radius - depth / 2)[..., None] * normal
    return Points(depth, place, normal)


def on_plate(one: Segments, plate: Plate) -> Points:
    """Return two points [..., 2] where each capsule touches a plate.

    They are the ends of the part of the capsule that lies above the rectangle. Where no part does, they are the nearest
    point, twice, and the second one counts as far away. So it is with a sphere.
    """
    start, end = (_in_frame(point, plate) for point in (one.start, one.end))
    way = end - start
    half, radius = jnp.asarray(plate.half), one.radius + plate.radius
    slope = jnp.where(jnp.abs(way[..., :2]) < 1e-9, 1e-9, way[..., :2])
    at_low, at_high = (-half - start[..., :2]) / slope, (half - start[..., :2]) / slope
    first, last = jnp.minimum(at_low, at_high), jnp.maximum(at_low, at_high)
    enters = jnp.clip(jnp.max(first, -1), 0.0, 1.0)
    leaves = jnp.clip(jnp.min(last, -1), 0.0, 1.0)
    above = (jnp.max(first, -1) <= jnp.min(last, -1)) & (jnp.max(first, -1) <= 1) & (jnp.min(last, -1) >= 0)
    breaks = jnp.clip(jnp.concatenate([first, last], -1), 0.0, 1.0)
    nearest = _nearest(start, way, half, breaks)
    share = jnp.stack([jnp.where(above, enters, nearest), leaves], -1)
    point = start[..., None, :] + share[..., None] * way[..., None, :]
    side = jnp.where(start[..., 2] + end[..., 2] < 0, -1.0, 1.0)[..., None]  # that of the capsule's middle
    held = jnp.clip(point[..., :2], -half[..., None, :], half[..., None, :])
    off = jnp.concatenate([point[..., :2] - held, point[..., 2:]], -1)
    length = jnp.sqrt(jnp.maximum(_dot(off, off), 1e-18))
    face = jnp.stack([0 * side, 0 * side, side], -1)
    normal = jnp.where(above[..., None, None], face, off / length[..., None])
    depth = radius[..., None] - jnp.where(above[..., None], side * point[..., 2], length)
    single = ~above | (_dot(way, way) < 1e-12)
    depth = depth.at[..., 1].set(jnp.where(single, depth[..., 0] - 100.0, depth[..., 1]))
    normal = jnp.matmul(normal, jnp.swapaxes(plate.frame, -1, -2))
    world = plate.centre[..., None, :] + jnp.matmul(point, jnp.swapaxes(plate.frame, -1, -2))
    radius = jnp.broadcast_to(jnp.asarray(one.radius), depth.shape[:-1])[..., None]
    return Points(depth, world - (radius - depth / 2)[..., None] * normal, normal)


def _nearest(start: Array, way: Array, half: Array, breaks: Array) -> Array:
    """Return where on segments, 0 to 1, the point nearest to a rectangle is, [...].

    The slope of the squared distance along the segment is piecewise linear and grows. So its root lies between the two
    of its corners at which it changes sign.
    """
    ends = jnp.zeros((*breaks.shape[:-1], 1))
    corners = jnp.concatenate([breaks, ends, ends + 1.0], -1)

    point = start[..., None, :] + corners[..., None] * way[..., None, :]
    held = jnp.clip(point[..., :2], -half[..., None, :], half[..., None, :])
    off = jnp.concatenate([point[..., :2] - held, point[..., 2:]], -1)
    slope = jnp.sum(off * way[..., None, :], -1)
    low = jnp.max(jnp.where(slope <= 0, corners, 0.0), -1)
    high = jnp.min(jnp.where(slope >= 0, corners, 1.0), -1)
    at_low = jnp.max(jnp.where((slope <= 0) & (corners >= low[..., None]), slope, -jnp.inf), -1)
    at_high = jnp.min(jnp.where((slope >= 0) & (corners <= high[..., None]), slope, jnp.inf), -1)
    fall, rise = jnp.where(jnp.isfinite(at_low), -at_low, 0.0), jnp.where(jnp.isfinite(at_high), at_high, 0.0)
    share = fall / jnp.maximum(fall + rise, 1e-20)
    return jnp.where(jnp.isfinite(at_low), jnp.where(jnp.isfinite(at_high), low + share * (high - low), 1.0), 0.0)


def _in_frame(point: Array, plate: Plate) -> Array:
    return jnp.matmul((point - plate.centre)[..., None, :], plate.frame)[..., 0, :]


def _dot(one: Array, other: Array) -> Array:
    return jnp.sum(one * other, -1)


def plate_of_box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the axes [3, 3] (columns, in the box's frame), half sides of the core [2] and radius of a box's plate."""
    order = np.argsort(-half, kind="stable")
    axes = np.eye(3)[:, order]
    if np.linalg.det(axes) < 0:
        axes[:, 2] *= -1
    radius = float(half[order[2]])
    return axes, half[order[:2]] - radius, radius
