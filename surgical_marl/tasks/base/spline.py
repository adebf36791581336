"""Uniform cubic B-splines: smooth curves that stay within the hull of their control points.

A curve of n segments has n + 3 control points; its parameter u runs from 0 to n. Velocity and acceleration are those of
the differences of the control points, so bounds on these bound the curve (C. de Boor, "A practical guide to splines",
2001, ch. IX). The functions take numpy and JAX arrays.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np


def weights(f: Any) -> tuple[Any, Any, Any, Any]:
    """Of the four control points of a segment, at a share `f` [...] in 0 to 1 of it; [...] each."""
    g = 1 - f
    return g * g * g / 6, (4 - 6 * f * f + 3 * f * f * f) / 6, (4 - 6 * g * g + 3 * g * g * g) / 6, f * f * f / 6


def slopes(f: Any) -> tuple[Any, Any, Any]:
    """Of the three differences of a segment's control points in its derivative by u, [...] each."""
    g = 1 - f
    return g * g / 2, (1 + 2 * f * g) / 2, f * f / 2


def evaluate(control: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Points [..., m, 3] at parameters u [m] or [..., m] of curves with control points [..., n + 3, 3]."""
    u = np.broadcast_to(u, (*control.shape[:-2], np.shape(u)[-1]))
    k = np.clip(np.floor(u).astype(int), 0, control.shape[-2] - 4)
    near = [np.take_along_axis(control, (k + j)[..., None], axis=-2) for j in range(4)]
    return np.asarray(sum(w[..., None] * c for w, c in zip(weights(u - k), near, strict=True)))


def through(points: np.ndarray, closed: bool) -> np.ndarray:
    """Control points [..., n + 3, 3] of curves that pass through points [..., n + 1, 3] at u = 0, 1, ..., n.

    A closed curve goes on from the last point to the first, which are the same, as if it had no ends. An open one keeps
    its third derivative over the first two and over the last two segments ("not a knot").

    Raises:
        ValueError: fewer than four points, or three on a closed curve's round.
    """
    n = points.shape[-2] - 1
    if n < 3:
        raise ValueError(f"a spline needs at least 4 waypoints, not {n + 1}")
    given = points[..., :-1, :] if closed else points
    known = np.zeros((*given.shape[:-2], n + 3, points.shape[-1]))
    known[..., : given.shape[-2], :] = given
    return np.asarray(_inverse(n, closed) @ known)


def equal_steps(control: np.ndarray, steps: int, fine: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """Points [..., steps + 1, 3] at equal arc length along curves, from one end to the other, and lengths [...].

    Arc length is that of the polygon through `fine` points a segment."""
    u = np.linspace(0, control.shape[-2] - 3, fine * (control.shape[-2] - 3) + 1)
    points = evaluate(control, u)
    passed = np.cumsum(np.linalg.norm(np.diff(points, axis=-2), axis=-1), axis=-1)
    passed = np.concatenate([np.zeros((*passed.shape[:-1], 1)), passed], axis=-1)
    flat = passed.reshape(-1, len(u))
    shares = np.linspace(0, 1, steps + 1)
    at = np.array([np.interp(shares * row[-1], row, u) for row in flat]).reshape(*passed.shape[:-1], steps + 1)
    return evaluate(control, at), passed[..., -1]


def curvature(control: np.ndarray, fine: int = 4) -> np.ndarray:
    """The greatest curvature, 1/m, [...], of `fine` points a segment."""
    u = np.arange(0, control.shape[-2] - 3, 1 / fine)
    k, f = np.floor(u).astype(int), (u - np.floor(u))[:, None]
    ways, turns = np.diff(control, axis=-2), np.diff(control, 2, axis=-2)
    first = sum(w * ways[..., k + j, :] for j, w in enumerate(slopes(f)))
    second = (1 - f) * turns[..., k, :] + f * turns[..., k + 1, :]
    dot = lambda a, b: np.einsum("...i,...i", a, b)  # noqa: E731
    squared = np.maximum(dot(first, first), 1e-18)
    across = np.maximum(squared * dot(second, second) - dot(first, second) ** 2, 0)  # the cross product's square
    return np.asarray(np.sqrt(across / squared**3).max(-1))


@lru_cache(maxsize=16)
def _inverse(n: int, closed: bool) -> np.ndarray:
    """From points at u = 0, 1, ... and zeros to control points, [n + 3, n + 3]."""
    matrix = np.zeros((n + 3, n + 3))
    for row in range(n if closed else n + 1):
        matrix[row, row : row + 3] = np.array([1, 4, 1]) / 6
    if closed:
        for row in range(3):
            matrix[n + row, [row, n + row]] = 1, -1
    else:
        matrix[n + 1, :5] = matrix[n + 2, -5:] = [1, -4, 6, -4, 1]
    return np.asarray(np.linalg.inv(matrix))
