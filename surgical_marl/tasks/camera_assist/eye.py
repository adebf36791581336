"""The view of an endoscope: points in its picture, and postures in which it looks at them.

The endoscope's frame is x left, y up, z along the view, as that of the ECM's tip. A point is in view if it is within
the pictures of both eyes, and neither nearer than `NEAREST` nor farther away than `FARTHEST`. What is in front of it
does not count: tools are thin.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surgical_marl.scenes.scene import Mount

NEAREST = 0.02
"""Least distance along the view at which a point is in view, m: `match_image` keeps as far away from what it sees."""
FARTHEST = 0.3
"""Greatest distance along the view at which a point is in view, m: a pixel of a 64 x 64 picture there is 5.4 mm wide,
more than half a tool's shaft of 8 mm."""
CLOSE = 0.1
"""Least distance of the nearest point in a good view, m: there a square picture of 60 degrees is 115 mm wide.
Tools part faster than an endoscope draws back."""
FILL = 0.6
"""At a good distance the points fill this share of the picture, from its middle to its nearest edge."""
LONGEST = 0.2
"""The longest step of a joint in `look_at`, a share of its range."""
STEPS = 20
"""Steps of `look_at` from an unrelated posture."""
SMALL = 1e-4
"""Change of a joint, as a share of its range, for derivatives."""
DAMPING = 0.5
"""Damping of the steps of `look_at`: errors have kinks where another point becomes the outermost one."""
MIRROR = np.diag([-1.0, 1.0, -1.0])
"""Axes of the endoscope's frame in MuJoCo's camera frame."""


class Eye:
    """The camera of an arm in its scene. Functions take numpy or JAX arrays, with any leading dimensions.

    Args:
        mount: an arm with a `camera`.
    """

    def __init__(self, mount: Mount) -> None:
        assert mount.arm.camera is not None  # `Scene.find_camera` has found it
        self.mount, self.camera = mount, mount.arm.camera
        self.half = np.radians(self.camera.fovy / 2)
        """Half the field of view, rad: the picture is square."""

    def pose(self, q: Any) -> tuple[Any, Any]:
        """Return axes [..., 3, 3] and origin [..., 3] of the endoscope's frame in the world, m.

        Args:
            q: joint positions of the arm, [..., joints].
        """
        found = self.mount.arm.link_poses(q, (self.camera.link,))[self.camera.link]
        turn, origin = (part.astype(found.dtype) for part in (self.mount.rotation, self.mount.position))
        axes = turn @ found[..., :3, :3] @ MIRROR.astype(found.dtype)
        return axes, found[..., :3, 3] @ turn.T + origin

    def sees(self, point: Any) -> Any:
        """Return whether points [..., 3] of the endoscope's frame are in view, [...] bool."""
        x, y, z = (abs(point[..., i]) if i < 2 else point[..., i] for i in range(3))
        side = z * np.float32(np.tan(self.half))
        return (x + np.float32(self.camera.baseline / 2) < side) & (y < side) & (z >= NEAREST) & (z <= FARTHEST)

    def aim(self, points: Any) -> tuple[Any, Any]:
        """Return how far the view is from points [..., k, 3] of the endoscope's frame.

        Returns:
            The middle of the points' box in the picture, as angles from the view's axis to the left and up, in half
            fields of view, [..., 2]: 1 is the picture's edge. And the distance of the middle of their box in space
            along the view, less the good one, as a share of that, [...].
        """
        xp = points.__array_namespace__()
        aside = xp.sqrt(xp.sum(points[..., :2] ** 2, -1) + np.float32(1e-12))
        angles = (xp.arctan2(aside, points[..., 2]) / np.float32(self.half) / aside)[..., None] * points[..., :2]
        off = (angles.max(-2) + angles.min(-2)) / 2
        middle = (points.max(-2) + points.min(-2)) / 2
        side, depth = xp.maximum(abs(points[..., 0]), abs(points[..., 1])), middle[..., 2]
        far = xp.maximum(side / np.float32(FILL * np.tan(self.half)), np.float32(CLOSE))
        good = xp.clip(depth + xp.max(far - points[..., 2], -1), np.float32(CLOSE), np.float32(FARTHEST))
        return off, depth / good - 1

    def look_at(self, places: np.ndarray, start: np.ndarray, steps: int = STEPS) -> np.ndarray:
        """Return joint positions [n, joints] that look at places in the world from a good distance.

        Damped least squares of what `aim` returns, within the joints' limits. Half of the steps only turn the view
        towards the middle of the places: what is behind an endoscope says little about distances.

        Args:
            places: [n, k, 3], m.
            start: joint positions to start from, [n, joints].
            steps: how many.
        """
        lower, scale = self.mount.arm.lower, self.mount.arm.upper - self.mount.arm.lower
        share, middle = (start - lower) / scale, places.mean(1, keepdims=True)
        for number in range(steps):
            turns = number < steps // 2
            error, change = self._change(lower, scale, share, middle if turns else places, 0.0 if turns else 1.0)
            uphill = (change * error[..., None]).sum(-2)
            held = ((share <= 0) & (uphill > 0)) | ((share >= 1) & (uphill < 0))
            change = np.where(held[:, None], 0.0, change)
            square = np.swapaxes(change, -1, -2) @ change + DAMPING * np.eye(len(scale))
            step = np.linalg.solve(square, np.where(held, 0.0, uphill)[..., None])[..., 0]
            share = np.clip(share - np.clip(step, -LONGEST, LONGEST), 0.0, 1.0)
        return np.asarray(lower + share * scale)

    def _change(
        self, lower: np.ndarray, scale: np.ndarray, share: np.ndarray, places: np.ndarray, weight: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of `aim` [n, 3], the distance times a weight, and their derivatives [n, 3, joints].

        Joint positions are `lower` and a `share` [n, joints] of the ranges `scale`.
        """
        shifts = SMALL * np.concatenate([np.zeros((1, len(scale))), np.eye(len(scale))])
        axes, origin = self.pose(lower + (share + shifts[:, None]) * scale)
        off, depth = self.aim((places - origin[..., None, :]) @ axes)
        errors = np.concatenate([off, weight * depth[..., None]], -1)
        return errors[0], np.moveaxis((errors[1:] - errors[0]) / SMALL, 0, -1)
