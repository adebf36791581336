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


def capsule_distance(one: Capsule, other: Capsule) -> Any:
    """Return the signed distance of two capsules, m, [...]; negative where they overlap."""
    gap = axis_gap(one, other)[1]
    xp = gap.__array_namespace__()
    return xp.sqrt(xp.sum(gap * gap, -1)) - (one.radius + other.radius)


def axis_gap(one: Capsule, other: Capsule) -> tuple[Any, Any]:
    """Return where the segments of two capsules are closest.

    The closest points of the two lines are clamped to one segment and then to the other (C. Ericson, "Real-Time
    Collision Detection", 2005, section 5.1.9). Of parallel segments any closest points may be found.

    Returns:
        How far along its axis the point of the first is from its centre, m, [...], and the vector from there to the
        point of the second, m, [..., 3].
    """
    between = one.centre - other.centre
    xp = between.__array_namespace__()
    b, d, e = (xp.sum(x * y, -1) for x, y in ((one.axis, other.axis), (one.axis, between), (other.axis, between)))
    parallel = 8 * xp.finfo(between.dtype).eps  # below this 1 - b^2 is rounding
    s = xp.clip((b * e - d) / xp.maximum(1 - b * b, parallel), -one.half, one.half)
    t = xp.clip(e + b * s, -other.half, other.half)
    s = xp.clip(b * t - d, -one.half, one.half)
    return s, t[..., None] * other.axis - s[..., None] * one.axis - between


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
