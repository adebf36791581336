"""Where a jaw can grip an object of wires or bars, on the host: poses of tools and the joint positions for them.

A grip is a number of a capsule of the object. The tool's y axis, along which its fingers close, is across the capsule,
and the z axis, along which they point, is as near to a wanted direction as that allows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.objects import Object
from surgical_marl.scenes.scene import Mount

CLOSE = 1e-4
"""A pose is reached when inverse kinematics comes this close: m, and parts of unit vectors."""
SPARE = 0.05
"""Least distance of a joint from its limits, as a share of its range; the jaw has none."""


def bars(item: Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles [c, 3] and the directions [c, 3] of an object's capsules, in its frame."""
    found = [(shape.position, shape.rotation[:, 2]) for shape in item.shapes if shape.kind == "capsule"]
    middles, directions = (np.array(part) for part in zip(*found, strict=True))
    return middles, directions


def tool_poses(place: Any, along: Any, pointing: Any, beyond: Any = 0.0) -> np.ndarray:
    """Return poses [..., 4, 4] of tools that grip bars.

    Args:
        place: middle of the bar, m, [..., 3].
        along: direction of the bar, [..., 3]; the tool's x axis.
        pointing: where the fingers should point, [..., 3].
        beyond: how far the tool tip is past the bar, m, [...].
    """
    z = pointing - _dot(pointing, along) * along
    z = z / np.sqrt(_dot(z, z))
    poses = np.zeros((*np.broadcast_shapes(np.shape(place), np.shape(z))[:-1], 4, 4))
    poses[..., :3, :3] = np.stack([along + 0 * z, np.cross(z, along), z], -1)
    poses[..., :3, 3], poses[..., 3, 3] = place + np.asarray(beyond)[..., None] * z, 1.0
    return poses


def joints_at(mount: Mount, poses: np.ndarray, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return joint positions [n, joints] of an arm whose tool is at poses [n, 4, 4] of the world, and if it gets there.

    Args:
        mount: the arm in its scene.
        poses: of its tool tip, in the world.
        start: joint positions to start from; home if None.

    Returns:
        The joint positions, and [n] bool: whether the pose is reached with all joints off their limits.
    """
    arm, own = mount.arm, poses.copy()
    own[:, :3, :3] = mount.rotation.T @ poses[:, :3, :3]
    own[:, :3, 3] = (poses[:, :3, 3] - mount.position) @ mount.rotation
    q = inverse_kinematics(arm, own, start, starts=1)
    off = np.abs(arm.forward_kinematics(q) - own).max((1, 2))
    moves = np.array([arm.jaw is None or joint.name != arm.jaw.joint for joint in arm.actuated])
    spare = (np.minimum(q - arm.lower, arm.upper - q) / (arm.upper - arm.lower))[:, moves].min(-1)
    return q, (off < CLOSE) & (spare > SPARE)


def tool_of(mount: Mount, q: np.ndarray) -> np.ndarray:
    """Return the pose [n, 4, 4] in the world of an arm's tool tip at joint positions [n, joints]."""
    pose = np.array(mount.arm.forward_kinematics(q))
    pose[..., :3, 3] = pose[..., :3, 3] @ mount.rotation.T + mount.position
    pose[..., :3, :3] = mount.rotation @ pose[..., :3, :3]
    return pose


def frames(position: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return poses [..., 4, 4] of positions [..., 3] and quaternions [..., 4]."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    poses = np.zeros((*w.shape, 4, 4))
    poses[..., :3, :3] = np.stack([np.stack(row, -1) for row in rows], -2)
    poses[..., :3, 3], poses[..., 3, 3] = position, 1.0
    return poses


def _dot(one: Any, other: Any) -> Any:
    return np.sum(one * other, -1, keepdims=True)
