"""Capsules and the distances between them, in numpy or JAX: one arithmetic for both, on arrays of any batch shape."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np


class Capsule(NamedTuple):
    """Points within `radius` of a segment. A sphere is a capsule of no length. Batches [...] of any array library."""

    centre: Any
    """Middle of the segment, m, [..., 3]."""
    axis: Any
    """Unit vector along the segment, [..., 3]."""
    half: Any
    """Half the segment's length, m, [...] or a number; 0 for a sphere."""
    radius: Any
    """m, [...] or a number."""

    def placed(self, rotation: Any, position: Any) -> Capsule:
        """Return the capsule as seen from the frame in which its own frame is at `rotation` and `position`.

        Args:
            rotation: axes of the capsule's frame, [..., 3, 3].
            position: origin of the capsule's frame, m, [..., 3].
        """
        centre, axis = ((rotation @ vector[..., None])[..., 0] for vector in (self.centre, self.axis))
        return Capsule(centre + position, axis, self.half, self.radius)

    def segment(self) -> Segment:
        """Return the capsule's segment, in the same batches."""
        xp = self.axis.__array_namespace__()
        half = xp.asarray(self.half, dtype=self.axis.dtype)
        per_length = xp.where(half > 0, 0.5 / xp.maximum(half, xp.finfo(half.dtype).tiny), 0.0)
        start = self.centre - half[..., None] * self.axis
        return Segment(start, 2 * half[..., None] * self.axis, per_length[..., None] * self.axis, 2 * half, per_length)


class Segment(NamedTuple):
    """The segment of a capsule. Of a sphere, which has none, all but the start is zero."""

    start: Any
    """Its first point, m, [..., 3]."""
    extent: Any
    """The way from its start to its end, m, [..., 3]."""
    dual: Any
    """The vector that turns a way into its share of the segment's length by a dot product, 1/m, [..., 3]."""
    length: Any
    """m, [...]."""
    per_length: Any
    """1 / length, 1/m, [...]."""


def capsule_distance(one: Capsule, other: Capsule) -> Any:
    """Return the signed distance of two capsules, m, [...]; negative where they overlap."""
    gap = axis_gap(one, other)[1]
    xp = gap.__array_namespace__()
    return xp.sqrt(xp.sum(gap * gap, -1)) - (one.radius + other.radius)


def axis_gap(one: Capsule, other: Capsule) -> tuple[Any, Any]:
    """Return where the segments of two capsules are closest.

    The closest points of the two lines are clamped to one segment and then to the other (C. Ericson, "Real-Time
    Collision Detection", 2005, section 5.1.9). Of parallel segments any closest points may be found.

    Positions along a segment are shares of its length: a GPU clamps a number to 0 and 1 in the instruction that
    computes it.

    Returns:
        Where on its segment the point of the first is, from 0 at the start to 1 at the end, [...], and the vector from
        there to the point of the second, m, [..., 3].
    """
    own, its = one.segment(), other.segment()
    between = own.start - its.start
    xp = between.__array_namespace__()
    # parallel capsules of a body have one axis: by its cosines, and not by extents, they share the root's denominator
    cosine = xp.sum(one.axis * other.axis, -1)
    parallel = 8 * xp.finfo(between.dtype).eps  # below this the squared sine is rounding
    b, back = cosine * (its.length * own.per_length), cosine * (own.length * its.per_length)
    d, e = xp.sum(own.dual * between, -1), xp.sum(its.dual * between, -1)
    s = xp.clip((b * e - d) / xp.maximum(1 - cosine * cosine, parallel), 0.0, 1.0)
    t = xp.clip(e + back * s, 0.0, 1.0)
    s = xp.clip(b * t - d, 0.0, 1.0)
    return s, t[..., None] * its.extent - s[..., None] * own.extent - between


def link_capsule(model: mujoco.MjModel, geom: int) -> Capsule:
    """Return a geom that is a capsule or a sphere, in the frame of its body."""
    radius, half, _ = model.geom_size[geom]
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE:
        half = 0.0
    shape = Capsule(np.zeros(3), np.array([0.0, 0.0, 1.0]), half, radius)
    return shape.placed(*frame(model.geom_pos[geom], model.geom_quat[geom]))


def frame(position: np.ndarray, quaternion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return axes [3, 3] and origin [3] of a frame from its origin and quaternion (w, x, y, z)."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3), position
