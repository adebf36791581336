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
