"""The centre line of a needle: an arc of a circle, by its length s from the tip to the tail.

    needle = Needle.of("needle", load_object("needle_sh"))
    arc = needle.at(origin, axes, size)        # in the world
    s = arc.nearest(place)                     # m from the tip; below 0 ahead of it
    foot, tangent = arc.point(s)               # the tangent points towards the tip

A straight needle is an arc of 1 km radius, which 60 mm of it leave by half a micrometre.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.scenes.objects import Object

TIP, TAIL = "tip", "tail"
"""Sites of a free object that make it a needle."""
STRAIGHT = 1e-3
"""Least curvature, 1/m."""


class Arc(NamedTuple):
    """A centre line in the world."""

    tip: Array
    """m, [3]"""
    along: Array
    """Unit tangent at the tip, forwards, [3]."""
    inward: Array
    """Unit vector from the tip to the centre of the circle, [3]."""
    bend: Array
    """Curvature, 1/m."""
    length: Array
    """From tip to tail, m."""

    def nearest(self, place: Array) -> Array:
        """Return the length from the tip to the point of the circle that is nearest to a place, m.

        It is half a circle more or less at most than that of the arc's middle.
        """
        way = place - self.tip
        angle = jnp.arctan2(-self.bend * (way @ self.along), 1 - self.bend * (way @ self.inward))
        behind = angle < self.bend * self.length / 2 - np.pi
        return jnp.where(behind, angle + 2 * np.pi, angle) / self.bend

    def point(self, s: Array) -> tuple[Array, Array]:
        """Return the point [3] at a length s from the tip, m, and the unit tangent [3] there, towards the tip."""
        angle = self.bend * s
        sine, half = jnp.sin(angle), jnp.sin(angle / 2)
        place = self.tip + (2 * half * half * self.inward - sine * self.along) / self.bend
        return place, jnp.cos(angle) * self.along - sine * self.inward


class Needle(NamedTuple):
    """A needle's centre line in the frame of its body: constants."""

    body: str
    """Name of the free object."""
    tip: tuple[float, ...]
    """m"""
    along: tuple[float, ...]
    inward: tuple[float, ...]
    bend: float
    length: float
    wire: float
    """Radius of the wire, m."""

    @classmethod
    def of(cls, name: str, about: Object) -> Needle | None:
        """Return the centre line of an object; None if it is no needle: not free, or without sites `tip` and `tail`.

        Raises:
            ValueError: its shapes do not lie along one arc from tip to tail.
        """
        if not about.free or not {TIP, TAIL} <= set(about.sites):
            return None
        tip, tail = (about.sites[site][0] for site in (TIP, TAIL))
        capsules = [shape for shape in about.shapes if shape.kind == "capsule"]
        half = np.array([shape.rotation[:, 2] * shape.size[1] for shape in capsules]).reshape(-1, 3)
        middle = np.array([shape.position for shape in capsules]).reshape(-1, 3)
        points, wire = np.concatenate([middle - half, middle + half]), max([shape.size[0] for shape in capsules] + [0])
        bad = ValueError(f"{name} has a tip and a tail, so its shapes must be capsules along one arc, or one straight"
                         " line, between them; otherwise rename one of both sites")  # fmt: skip
        if len(capsules) < len(about.shapes) or np.allclose(tip, tail):
            raise bad
        found = cls(name, *_through(tip, points, tail), float(wire))
        off = max(found._distance(point) for point in points)
        if not (off < wire and found._distance(tail) < wire):
            raise bad
        return found

    def at(self, origin: Any, axes: Any, size: Any = 1.0) -> Arc:
        """Return the centre line of a body whose frame has this origin, m, [3], and axes [3, 3].

        Args:
            origin: of the frame.
            axes: of the frame.
            size: factor of all its lengths.
        """
        tip, along, inward = (axes @ jnp.asarray(part, jnp.float32) for part in (self.tip, self.along, self.inward))
        return Arc(origin + size * tip, along, inward, jnp.float32(self.bend / size), jnp.float32(self.length * size))

    def _distance(self, point: np.ndarray) -> float:
        """Return the distance of a point from the circle, m."""
        tip, along, inward = map(np.array, (self.tip, self.along, self.inward))
        way, radius = point - tip - inward / self.bend, 1 / self.bend
        flat = np.hypot(way @ along, way @ inward)
        return float(np.hypot(flat - radius, way @ np.cross(along, inward)))


def _through(tip: np.ndarray, points: np.ndarray, tail: np.ndarray) -> tuple[Any, Any, Any, float, float]:
    """Return tip, tangent, direction to the centre, curvature and length of an arc: by the point that halves it."""
    away = np.abs(np.linalg.norm(points - tip, axis=1) - np.linalg.norm(points - tail, axis=1))
    middle = points[np.argmin(away)]
    if min(np.linalg.norm(middle - end) for end in (tip, tail)) < 1e-6:
        middle = (tip + tail) / 2
    a, b = middle - tip, tail - tip
    normal = np.cross(a, b)
    if np.linalg.norm(normal) < 1e-3 * np.linalg.norm(a) * np.linalg.norm(b):
        along = -b / np.linalg.norm(b)
        inward = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
        return _plain(tip, along, inward / np.linalg.norm(inward), STRAIGHT, float(np.linalg.norm(b)))
    way = np.cross((a @ a) * b - (b @ b) * a, normal) / (2 * normal @ normal)  # from the tip to the centre
    radius = float(np.linalg.norm(way))
    inward = way / radius
    along = -a + inward * (inward @ a)
    chords = [float(np.linalg.norm(way)) for way in (a, tail - middle)]
    length = sum(2 * radius * math.asin(min(1.0, chord / (2 * radius))) for chord in chords)
    return _plain(tip, along / np.linalg.norm(along), inward, 1 / radius, length)


def _plain(tip: Any, along: Any, inward: Any, bend: float, length: float) -> tuple[Any, Any, Any, float, float]:
    """Return vectors as tuples of numbers, which can be a part of a cache's key."""
    return tuple(tip.tolist()), tuple(along.tolist()), tuple(inward.tolist()), bend, length
