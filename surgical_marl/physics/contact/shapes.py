"""Contact points of shapes of objects with those of arms and other objects: places, depths and normals, in pure JAX.

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

NEAR = 0.02
"""Angle between a capsule and what it touches, rad, up to which its nearest point is not at its nearer end: how far a
capsule of some mm turns as its one end goes in by the overlap of a firm grip."""
EVEN = 0.2
"""Angle likewise up to which a capsule has a point near its farther end: more than it turns within a step, so that a
step knows on what it will rest."""
_POINTS = ((0.5, NEAR), (0.0, EVEN), (1.0, EVEN))
"""Anchor of each of a capsule's three points, as a share of the length, and the angle of its penalty."""


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

    C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.9. Along parallel capsules any points are nearest;
    here they are those in the middle, and become those as the angle goes below `NEAR`.
    """
    d1, d2, r = one.end - one.start, other.end - other.start, one.start - other.start
    a, e, b = _dot(d1, d1), _dot(d2, d2), _dot(d1, d2)
    c, f = _dot(d1, r), _dot(d2, r)
    tiny = 1e-12  # of a sphere; lengths below 1 um
    even = NEAR**2 * a * e + tiny**2
    s = jnp.clip((b * f - c * e + even / 2) / (jnp.maximum(a * e - b * b, 0.0) + even), 0.0, 1.0)
    t = jnp.clip((b * s + f) / jnp.maximum(e, tiny), 0.0, 1.0)
    s = jnp.clip((b * t - c) / jnp.maximum(a, tiny), 0.0, 1.0)
    gap = r + s[..., None] * d1 - t[..., None] * d2
    length = jnp.sqrt(jnp.maximum(_dot(gap, gap), 1e-18))
    normal = gap / length[..., None]
    depth = one.radius + other.radius - length
    place = one.start + s[..., None] * d1 - (one.radius - depth / 2)[..., None] * normal
    return Points(depth, place, normal)


def on_plate(one: Segments, plate: Plate) -> Points:
    """Return three points [..., 3] where each capsule is near a plate: its nearest point, and one for each end.

    Each point minimises the distance to the plate plus a small penalty on its distance along the capsule from an
    anchor: the middle, or one of the ends. The penalty is half of an angle, times the capsule's length, times the
    square of the distance from the anchor as a share of that length. So a capsule that lies flat has its points in the
    middle and at both ends, or at the edges of the plate where it juts out. As it turns by that angle they move to its
    lower end. These are proximal points (J. J. Moreau, "Proximité et dualité dans un espace hilbertien", 1965): they
    move no faster than the capsule's length over the angle, however the shapes lie. Depth and normal are those of the
    points themselves, and change no faster than these move.

    The ends of the part above the plate, for example, would not do: they jump when the capsule leaves over an edge.
    """
    start, end = (in_frame(point, plate) for point in (one.start, one.end))
    extent = end - start
    half, radius = jnp.asarray(plate.half), one.radius + plate.radius
    share = _nearest(start, extent, half, radius * jnp.sqrt(jnp.maximum(_dot(extent, extent), 1e-18)))
    point = start[..., None, :] + share[..., None] * extent[..., None, :]
    off = _off(point, half)
    length = jnp.sqrt(jnp.maximum(_dot(off, off), 1e-18))
    depth, normal = radius[..., None] - length, off / length[..., None]
    normal = jnp.matmul(normal, jnp.swapaxes(plate.frame, -1, -2))
    world = plate.centre[..., None, :] + jnp.matmul(point, jnp.swapaxes(plate.frame, -1, -2))
    radius = jnp.broadcast_to(jnp.asarray(one.radius), depth.shape[:-1])[..., None]
    return Points(depth, world - (radius - depth / 2)[..., None] * normal, normal)


def _nearest(start: Array, extent: Array, half: Array, scale: Array) -> Array:
    """Return where on segments, 0 to 1, their three points near a rectangle are, [..., 3].

    Half the squared distance has a slope along the segment that grows piecewise linearly, with corners where the
    segment passes a side of the rectangle. The slope of the penalty is linear: the angle, times `scale` [...] (the sum
    of the radii times the capsule's length), times the distance from the anchor. The root of their sum lies between the
    last corner where it is negative and the first one where it is positive.
    """
    slope = jnp.where(jnp.abs(extent[..., :2]) < 1e-9, 1e-9, extent[..., :2])
    ends = (-half - start[..., :2]) / slope, (half - start[..., :2]) / slope
    first, last = (jnp.clip(order(*ends), 0.0, 1.0) for order in (jnp.minimum, jnp.maximum))
    corners = jnp.stack(_sorted(*(first[..., 0], last[..., 0], first[..., 1], last[..., 1])), -1)
    none = jnp.zeros((*corners.shape[:-1], 1))
    corners = jnp.concatenate([none, corners, none + 1.0], -1)
    point = start[..., None, :] + corners[..., None] * extent[..., None, :]
    rise = jnp.sum(_off(point, half) * extent[..., None, :], -1)
    found = [_root(corners, rise + even * scale[..., None] * (corners - anchor)) for anchor, even in _POINTS]
    return jnp.stack(found, -1)


def _sorted(a: Array, b: Array, c: Array, d: Array) -> tuple[Array, Array, Array, Array]:
    """Return four numbers in order, of which `a <= b` and `c <= d`."""
    low, middle, other, high = jnp.minimum(a, c), jnp.maximum(a, c), jnp.minimum(b, d), jnp.maximum(b, d)
    return low, jnp.minimum(middle, other), jnp.maximum(middle, other), high


def _root(corners: Array, slope: Array) -> Array:
    """Return where a function that grows from corner to corner [..., n] is 0, or the end that is nearest to that."""
    low, high = (corners[..., 0], slope[..., 0]), (corners[..., -1], slope[..., -1])
    for k in range(1, corners.shape[-1] - 1):
        low = _where(slope[..., k] <= 0, (corners[..., k], slope[..., k]), low)
        high = _where(slope[..., -1 - k] >= 0, (corners[..., -1 - k], slope[..., -1 - k]), high)
    share = jnp.clip(-low[1] / jnp.maximum(high[1] - low[1], 1e-20), 0.0, 1.0)
    return low[0] + share * (high[0] - low[0])


def _where(condition: Array, one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    return jnp.where(condition, one[0], other[0]), jnp.where(condition, one[1], other[1])


def _off(point: Array, half: Array) -> Array:
    """Return the offset of points [..., q, 3] from the nearest points of rectangles with half sides [..., 2]."""
    held = jnp.clip(point[..., :2], -half[..., None, :], half[..., None, :])
    return jnp.concatenate([point[..., :2] - held, point[..., 2:]], -1)


def in_frame(point: Array, plate: Plate) -> Array:
    """Return where points [..., 3] are in the frames of plates [...]."""
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
