"""Grasp poses of objects of wires or bars, on the host: poses of tools and the joint positions for them.

A grip is a number of a capsule of the object. The tool's y axis, along which its fingers close, is across the capsule,
and the z axis, along which they point, is as near to a wanted direction as that allows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.scenes.objects import Object
from surgical_marl.scenes.scene import Mount

CLOSE = 1e-4
"""A pose is reached when inverse kinematics comes this close: m, and parts of unit vectors."""
DOWN = np.array([0.0, 0.0, -1.0])
SPARE = 0.05
"""Least distance of a joint from its limits, as a share of its range; the jaw has none."""


def bars(item: Object) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles [c, 3] and the directions [c, 3] of an object's capsules, in its frame."""
    found = [(shape.position, shape.rotation[:, 2]) for shape in item.shapes if shape.kind == "capsule"]
    middles, directions = (np.array(part) for part in zip(*found, strict=True))
    return middles, directions


def tool_poses(
    place: np.ndarray, along: np.ndarray, pointing: np.ndarray, beyond: float | np.ndarray = 0.0
) -> np.ndarray:
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


def bar(body: np.ndarray, item: Object, number: int | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle [n, 3] and the direction [n, 3] of one bar of an object at poses [n, 4, 4].

    Args:
        body: of the object.
        item: the object.
        number: of the bar, or of one for each pose, [n].
    """
    middles, directions = (np.broadcast_to(part[number], (len(body), 3)) for part in bars(item))
    turn = body[:, :3, :3]
    return body[:, :3, 3] + np.einsum("nij,nj->ni", turn, middles), np.einsum("nij,nj->ni", turn, directions)


def from_above(mount: Mount, place: np.ndarray, along: np.ndarray, beyond: float) -> np.ndarray:
    """Return poses [n, 4, 4] of tools that point down at bars, whichever way round they need to turn least.

    Args:
        mount: the arm.
        place: middles of the bars, m, [n, 3].
        along: their directions, [n, 3], of which the horizontal part counts.
        beyond: how far the tool tip is past the bar, m.
    """
    flat = along * [1.0, 1.0, 0.0]
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    flat = np.where((flat @ tool_of(mount, mount.arm.home)[:3, 0])[:, None] < 0, -flat, flat)
    return tool_poses(place, flat, DOWN, np.full(len(place), beyond))


def leaning(rng: np.random.Generator, count: int, lean: float) -> np.ndarray:
    """Return poses [count, 4, 4] at the origin of tools that lean at random from the vertical, by up to `lean` rad."""
    bearing, yaw = rng.uniform(-np.pi, np.pi, (2, count))
    away = lean * np.sqrt(rng.random(count))
    pointing = np.stack([np.sin(away) * np.cos(bearing), np.sin(away) * np.sin(bearing), -np.cos(away)], -1)
    along = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(count)], -1)
    along -= _dot(along, pointing) * pointing
    return tool_poses(np.zeros((count, 3)), along / np.sqrt(_dot(along, along)), pointing, np.zeros(count))


def drawn_about(
    rng: np.random.Generator, centre: np.ndarray, spread: float, count: int, heights: np.ndarray
) -> np.ndarray:
    """Return places [count, 3] in the world within `spread` of a vertical axis, between two heights [2, count], m."""
    away, bearing = spread * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    low, high = heights
    places = np.stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(low, high)], -1)
    places[:, :2] += centre
    return places


def lowest_bar(body: np.ndarray, item: Object) -> np.ndarray:
    """Return the height [n] of the lowest middle of a bar of an object at poses [n, 4, 4], m."""
    middles, _ = bars(item)
    return (body[:, None, 2, 3] + np.einsum("nj,cj->nc", body[:, 2, :3], middles)).min(1)


def moved(poses: np.ndarray, way: ArrayLike) -> np.ndarray:
    """Return poses [n, 4, 4] shifted by a way [3] or [n, 3] in the world, m."""
    shifted = poses.copy()
    shifted[:, :3, 3] += np.asarray(way)
    return shifted


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
    moves = ~arm.moves_jaw
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


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.sum(one * other, -1, keepdims=True)
