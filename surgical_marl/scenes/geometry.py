"""Distances between capsules, on numpy arrays of any batch shape."""

from __future__ import annotations

import numpy as np

Capsule = tuple[np.ndarray, np.ndarray, float]
"""End points [..., 3] of the axis in the world and radius, m."""


def capsule_distance(one: Capsule, other: Capsule) -> np.ndarray:
    """Distance in m of two capsules over a batch [...], negative where they overlap."""
    return segment_distance(*one[:2], *other[:2]) - one[2] - other[2]


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Least distance between segments ab and cd, end points [..., 3] -> [...].

    The closest points of the two lines, clamped to one segment and then to the other (C. Ericson, Real-Time Collision
    Detection, section 5.1.9).
    """
    u, v, w = b - a, d - c, a - c
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    uw, vw = _dot(u, w), _dot(v, w)
    tiny = 1e-12
    s = np.clip((uv * vw - uw * vv) / np.maximum(uu * vv - uv * uv, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    gap = w + s[..., None] * u - t[..., None] * v
    return np.sqrt(_dot(gap, gap))


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.sum(x * y, axis=-1)
