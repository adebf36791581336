"""Poses of free objects: of one, and of many environments in arrays of numpy or torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np


class Pose(NamedTuple):
    """The frame of an object in the world, [...]."""

    position: Any
    """Of its origin, m, [..., 3]; for most shapes not the centre of mass."""
    quaternion: Any
    """w, x, y, z, of length 1, [..., 4]."""


@dataclass(frozen=True)
class Poses:
    """The frames of k objects in N environments, in the world. Objects are in the order of `Scene.free_objects`."""

    origin: Any
    """m, [N, k, 3]; for most shapes not the centre of mass."""
    quaternion: Any
    """w, x, y, z, [N, k, 4]."""


def along(start: Any, end: Any) -> tuple[Any, Any]:
    """Return the middle [..., 3] of lines, and the quaternion [..., 4] that turns z along each.

    Args:
        start: of the lines, m, [..., 3], of numpy or torch.
        end: likewise.
    """
    way = end - start
    xp: Any = np
    if not isinstance(start, np.ndarray):
        import torch

        xp = torch
    x, y, z = (way[..., axis] for axis in range(3))
    real = (x * x + y * y + z * z) ** 0.5 + z  # half of the way from z to the line
    down = real < 1e-3 * abs(z)  # against z, any axis across will do
    turn = xp.stack([xp.where(down, 0 * z, real), xp.where(down, 0 * z + 1, -y), xp.where(down, 0 * z, x), 0 * z], -1)
    return (start + end) / 2, turn / ((turn * turn).sum(-1) ** 0.5)[..., None]


def frames(position: Any, quaternion: Any, centers: Any) -> Poses:
    """Return the poses of objects from their centres of mass.

    Args:
        position: of the centres of mass in the world, m, [N, k, 3].
        quaternion: w, x, y, z, of length 1, [N, k, 4].
        centers: of mass in the objects' own frames, m, [k, 3] or [N, k, 3], in the same library and on the same device.
    """
    real, axis = quaternion[..., :1], quaternion[..., 1:]
    if isinstance(position, np.ndarray):
        cross = np.cross
    else:
        import torch

        cross, centers = torch.linalg.cross, torch.broadcast_to(centers, axis.shape)
    sideways = 2 * cross(axis, centers)
    return Poses(position - (centers + real * sideways + cross(axis, sideways)), quaternion)
