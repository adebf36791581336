"""Boxes around places: where joints and tool tips can be."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

STARTS, POINTS, SWEEPS = 8, 17, 3


class Box(NamedTuple):
    """Least and greatest values of a vector, [d] each."""

    low: np.ndarray
    high: np.ndarray

    def minus(self, other: Box) -> Box:
        """Return the bounds of differences of two vectors, of which the second is in `other`."""
        return Box(self.low - other.high, self.high - other.low)

    def widened(self, share: float, least: float = 0.0) -> Box:
        """Return a box that is wider at each end by a share of its width, and `least` more."""
        more = share * (self.high - self.low) + least
        return Box(self.low - more, self.high + more)

    @property
    def corners(self) -> np.ndarray:
        """All its corners, [2**d, d]."""
        return np.stack(np.meshgrid(*zip(*self, strict=True)), -1).reshape(-1, len(self.low))


def box_of(place: Callable[[np.ndarray], np.ndarray], joints: Box) -> Box:
    """Return the box of all places that joints within a box lead to.

    Each of its sides is found by moving one joint after the other to where the place is furthest, from some postures.

    Args:
        place: joint positions [..., n] -> place [..., d].
        joints: bounds of the joint positions, [n] each.
    """
    sides = len(place(joints.low))
    ways = np.concatenate([np.eye(sides), -np.eye(sides)])
    q = np.random.default_rng(0).uniform(*joints, (len(ways), STARTS, len(joints.low)))

    def far(q: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("ws...x,wx->ws...", place(q), ways))

    for _ in range(SWEEPS):
        for joint, values in enumerate(np.linspace(*joints, POINTS).T):
            tried = np.repeat(q[:, :, None], POINTS + 1, 2)
            tried[:, :, 1:, joint] = values
            q = np.take_along_axis(tried, far(tried).argmax(-1)[..., None, None], 2)[:, :, 0]
    furthest = far(q).max(-1)
    return Box(-furthest[sides:], furthest[:sides])
