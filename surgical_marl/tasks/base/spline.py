"""Uniform cubic B-splines: smooth curves that stay within the hull of their control points.

A curve of n segments has n + 3 control points; its parameter u runs from 0 to n. Velocity and acceleration are those of
the differences of the control points, so bounds on these bound the curve (C. de Boor, "A practical guide to splines",
2001, ch. IX). The host makes and measures curves with SciPy, which is imported only then: tables of paths are cached.
`weights` and `slopes` take JAX arrays; environments evaluate points with them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


def weights(f: Any) -> tuple[Any, Any, Any, Any]:
    """Return the weights of a segment's four control points, [...] each, at a share `f` [...] of it, 0 to 1."""
    g = 1 - f
    return g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6, (4 - 6 * g * g + 3 * g * g * g) / 6, f * f * f / 6


def slopes(f: Any) -> tuple[Any, Any, Any]:
    """Return the weights of the three differences of a segment's control points in its derivative by u, [...] each."""
    g = 1 - f
    return g * g / 2, (1 + 2 * f * g) / 2, f * f / 2


def evaluate(control: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return points [..., m, 3] at parameters u [m] of curves with control points [..., n + 3, 3]."""
    return np.asarray(_curve(control)(u))


def through(points: np.ndarray, closed: bool) -> np.ndarray:
    """Return control points [..., n + 3, 3] of curves that pass through points [..., n + 1, 3] at u = 0, 1, ..., n.

    On a closed curve the last point equals the first, and the curve is smooth there. An open one keeps
    its third derivative over the first two and over the last two segments ("not a knot").

    Raises:
        ValueError: fewer than four points, or fewer than three different points on a closed curve.
    """
    from scipy.interpolate import CubicSpline

    n = points.shape[-2] - 1
    if n < 3:
        raise ValueError(f"a spline needs at least 4 waypoints, not {n + 1}")
    if closed:  # the ends differ by rounding, which SciPy does not accept
        points = np.concatenate([points[..., :-1, :], points[..., :1, :]], axis=-2)
    curve = CubicSpline(np.arange(n + 1), points, axis=-2, bc_type="periodic" if closed else "not-a-knot")
    # At a knot the point is (c0 + 4 c1 + c2) / 6 and the second derivative c0 - 2 c1 + c2.
    inner = points - curve(np.arange(n + 1), 2) / 6
    first = 6 * points[..., :1, :] - 4 * inner[..., :1, :] - inner[..., 1:2, :]
    last = 6 * points[..., -1:, :] - 4 * inner[..., -1:, :] - inner[..., -2:-1, :]
    return np.concatenate([first, inner, last], axis=-2)


def equal_steps(control: np.ndarray, steps: int, fine: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Return points [..., steps + 1, 3] at equal arc length along curves, from end to end, and the lengths [...].

    Arc length is that of the polygon through `fine` points a segment.
    """
    n = control.shape[-2] - 3
    u, shares = np.linspace(0, n, fine * n + 1), np.linspace(0, 1, steps + 1)
    ways = np.linalg.norm(np.diff(evaluate(control, u), axis=-2), axis=-1)
    passed = np.concatenate([np.zeros((*ways.shape[:-1], 1)), np.cumsum(ways, axis=-1)], axis=-1)
    rows = zip(control.reshape(-1, n + 3, control.shape[-1]), passed.reshape(-1, len(u)), strict=True)
    points = [evaluate(curve, np.interp(shares * row[-1], row, u)) for curve, row in rows]
    return np.reshape(points, (*passed.shape[:-1], steps + 1, -1)), passed[..., -1]


def curvature(control: np.ndarray, fine: int = 4) -> np.ndarray:
    """Return the greatest curvature of each curve, 1/m, [...], at `fine` points a segment."""
    curve, u = _curve(control), np.arange(0, control.shape[-2] - 3, 1 / fine)
    first, second = curve(u, 1), curve(u, 2)

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("...i,...i", a, b))

    squared = np.maximum(dot(first, first), 1e-18)
    across = np.maximum(squared * dot(second, second) - dot(first, second) ** 2, 0)  # the cross product's square
    return np.asarray(np.sqrt(across / squared**3).max(-1))


def _curve(control: np.ndarray) -> BSpline:
    from scipy.interpolate import BSpline

    return BSpline(np.arange(-3, control.shape[-2] + 1), control, 3, axis=control.ndim - 2)
