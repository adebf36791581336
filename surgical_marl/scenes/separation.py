"""Proves whether two geoms of a model can come near each other anywhere within the joint limits.

The method is branch and bound over the ranges of the joints between the two geoms. For a box of joint positions two
things are known: the distance of the geoms in its middle, and how far the joints can move them from there within the
box. A box in which the geoms can't come near is dropped. Other boxes are halved across the joint that moves the geoms
most; boxes with the nearest geoms come first. The search ends when it finds a posture in which the geoms are near, or
when no box is left, which proves that there is no such posture. From time to time a descent starts from the nearest
postures, which finds most pairs that can come near after few boxes. A pair whose search takes too long counts as one
that can come near, because watching a pair for nothing costs little, and a missed overlap costs more.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from surgical_marl.scenes.geometry import Capsule, axis_gap, frame, link_capsule

BATCH = 256
"""Least number of boxes that are halved at a time. A near posture is found after fewer boxes if it is small, but each
box takes longer."""
BOXES = 400_000
"""Boxes of the longest search. Pairs of the shipped scenes take up to 313,000, one or two seconds."""
WALKERS, STEPS = 32, 40
"""Number of the nearest postures of a search from which a descent starts, and number of its steps."""
HALVINGS, FEW_HALVINGS, MANY = 8, 4, 16
"""Number of halvings of a geom's range to find the ball in which it stays, and their number if it has many joints."""


@dataclass(frozen=True)
class _Joint:
    """A joint that turns about or slides along an axis through the origin of its frame.

    The frame is given in that of the joint before it.
    """

    rotation: np.ndarray
    position: np.ndarray
    axis: np.ndarray
    slides: bool
    low: float
    high: float

    def turn(self, angle: np.ndarray) -> np.ndarray:
        """Return rotations about the axis by angles [k], [k, 3, 3] (Rodrigues' formula)."""
        x, y, z = self.axis
        cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), angle[:, None, None]
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


class Limb:
    """A geom, and the n joints between it and a body that carries it.

    Args:
        model: a model of hinges and slides, each with limits and at the origin of its body, as a URDF's are.
        geom: id of a capsule or a sphere.
        root: id of the body that carries it; 0 is the world.
    """

    def __init__(self, model: mujoco.MjModel, geom: int, root: int = 0) -> None:
        self.joints: list[_Joint] = []
        rotation, position = np.eye(3), np.zeros(3)
        for body in _carriers(model, geom, root):
            local, offset = frame(model.body_pos[body], model.body_quat[body])
            rotation, position = rotation @ local, position + rotation @ offset
            if model.body_jntnum[body]:
                joint = model.joint(int(model.body_jntadr[body]))
                slides = joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE
                self.joints.append(_Joint(rotation, position, joint.axis, slides, *joint.range))
                rotation, position = np.eye(3), np.zeros(3)
        self._shape = link_capsule(model, geom).placed(rotation, position)

    def limits(self) -> np.ndarray:
        """Return the box of all joint positions, [1, 2, n]: its middle and half its sides."""
        low, high = np.array([(joint.low, joint.high) for joint in self.joints]).reshape(-1, 2).T
        return np.stack([low + high, high - low])[None] / 2

    def place(self, q: np.ndarray) -> tuple[Capsule, np.ndarray]:
        """Return where the geom is at joint positions [k, n], and how its ends move with each joint.

        Returns:
            The capsules [k] in the root's frame, and the speeds of both ends by joint rate, m/rad or 1, [k, n, 2, 3].
        """
        rotation, position = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
        axes, origins = [], []
        for joint, value in zip(self.joints, q.T, strict=True):
            position, rotation = position + rotation @ joint.position, rotation @ joint.rotation
            axes.append(rotation @ joint.axis)
            origins.append(position)
            if joint.slides:
                position = position + value[:, None] * axes[-1]
            else:
                rotation = rotation @ joint.turn(value)
        capsule = self._shape.placed(rotation, position)
        reach = capsule.half * capsule.axis
        ends = np.stack([capsule.centre - reach, capsule.centre + reach], 1)
        speeds = np.empty((*q.shape, 2, 3))
        for k, joint in enumerate(self.joints):
            axis = axes[k][:, None]
            speeds[:, k] = axis if joint.slides else np.cross(axis, ends - origins[k][:, None])
        return capsule, speeds

    def moves(self, speeds: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far each joint moves the geom at most, within boxes around where `place` was called.

        Args:
            speeds: from `place`, [k, n, 2, 3].
            half: half the sides of the boxes, [k, n].

        Returns:
            Lengths [k, n] in m: no point of the geom moves farther than their sum. And the greatest speeds [k, n] that
            a joint gives the geom anywhere in its box.
        """
        moves, levers, moved = np.empty_like(half), np.linalg.norm(speeds, axis=-1).max(-1), np.zeros(len(half))
        # from the geom towards the root: joints nearer to the geom have already moved it nearer to an axis or farther
        # off
        for k in reversed(range(len(self.joints))):
            if self.joints[k].slides:
                moves[:, k] = half[:, k]
            else:
                levers[:, k] += moved
                moves[:, k] = 2 * np.sin(np.minimum(half[:, k], np.pi) / 2) * levers[:, k]
            moved = moved + moves[:, k]
        return moves, levers

    def moves_along(self, normal: np.ndarray, speeds: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Return the same lengths [k, n] for the way along unit vectors [k, 3] alone.

        To first order that is the speeds along the vector. The rest is bounded by Taylor's theorem: the second
        derivative of a point by the joints i and j, j nearer to the geom or the same, is no longer than the point's
        speed by j if i turns, and zero if it slides.
        """
        moves, levers = self.moves(speeds, half)
        turns = half * [not joint.slides for joint in self.joints]
        bent = levers * half * (np.cumsum(turns, 1) - turns / 2)
        along = np.abs((speeds @ normal[:, None, :, None])[..., 0]).max(-1) * half + bent
        return np.where(along.sum(1, keepdims=True) < moves.sum(1, keepdims=True), along, moves)


def can_meet(model: mujoco.MjModel, one: int, other: int, near: float, most: int = BOXES) -> tuple[bool, int]:
    """Return whether two geoms can come as near as `near`, m, within the joint limits, and how many boxes that took.

    False is certain. So is True, unless the search ended after `most` boxes.
    """
    root = _last_common(_carriers(model, one), _carriers(model, other))
    limbs = Limb(model, one, root), Limb(model, other, root)
    boxes = np.concatenate([limb.limits() for limb in limbs], axis=2)
    waiting, distance, widest, seen, tried = boxes[:0], np.zeros(0), np.zeros(0, int), 0, 4 * BATCH
    while len(boxes):
        apart, moves = _bound(limbs, boxes)
        seen += len(boxes)
        if (apart < near).any() or seen > most:
            return True, seen
        if (kept := apart - moves.sum(1) < near).any():
            waiting = np.concatenate([waiting, boxes[kept]])
            distance = np.concatenate([distance, apart[kept]])
            widest = np.concatenate([widest, moves[kept].argmax(1)])
        order = np.argsort(distance)
        if seen > tried:
            tried = 4 * seen
            if _descend(limbs, waiting[order[:WALKERS], 0], near):
                return True, seen
        now, later = np.split(order, [max(BATCH, len(distance) // 4)])
        boxes = _halved(waiting[now], widest[now])
        waiting, distance, widest = waiting[later], distance[later], widest[later]
    return False, seen


def _descend(limbs: tuple[Limb, Limb], q: np.ndarray, near: float) -> bool:
    """Return whether projected Newton steps from postures [k, n] bring two geoms as near as that."""
    limits = np.concatenate([limb.limits()[0] for limb in limbs], axis=1)
    low, high = limits[0] - limits[1], limits[0] + limits[1]
    for _ in range(STEPS):
        parts = np.split(q, [len(limbs[0].joints)], axis=1)
        (one, speeds), (other, its_speeds) = (limb.place(part) for limb, part in zip(limbs, parts, strict=True))
        (here, gap), (there, _) = axis_gap(one, other), axis_gap(other, one)
        length = np.linalg.norm(gap, axis=-1)
        distance = length - one.radius - other.radius
        if (distance < near).any():
            return True
        normal = gap / length[:, None]
        slopes = [
            sign * np.einsum("kj,knj->kn", normal, _at(where, by_joint))
            for sign, where, by_joint in ((-1, here, speeds), (1, there, its_speeds))
        ]
        slope = np.concatenate(slopes, axis=1)
        slope[((q <= low) & (slope > 0)) | ((q >= high) & (slope < 0))] = 0.0
        step = slope * (distance / np.maximum((slope * slope).sum(1), 1e-9))[:, None]
        q = np.clip(q - np.clip(step, -limits[1] / 4, limits[1] / 4), low, high)
    return False


def _at(where: np.ndarray, speeds: np.ndarray) -> np.ndarray:
    """Return the speeds [k, n, 3] of points on a capsule's segment, from those of its ends [k, n, 2, 3].

    `where` [k] is the point's share of the way from the first end to the second.
    """
    share = where[:, None, None]
    return (1 - share) * speeds[:, :, 0] + share * speeds[:, :, 1]


def ball(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float]:
    """Return centre [3] and radius, m, of a ball in the world that a geom stays in within the joint limits."""
    limb = Limb(model, geom)
    boxes = limb.limits()
    for _ in range(min(len(limb.joints), 1) * (HALVINGS if len(limb.joints) <= MANY else FEW_HALVINGS)):
        speeds = limb.place(boxes[:, 0])[1]
        boxes = _halved(boxes, limb.moves(speeds, boxes[:, 1])[0].argmax(1))
    capsule, speeds = limb.place(boxes[:, 0])
    centre = capsule.centre.mean(0)
    away = np.linalg.norm(capsule.centre - centre, axis=-1) + limb.moves(speeds, boxes[:, 1])[0].sum(1)
    return centre, float(away.max() + capsule.half + capsule.radius)


def _bound(limbs: tuple[Limb, Limb], boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of two geoms in the middle of boxes [k, 2, n], and how much each joint can reduce it.

    The distances are in m, [k]. The second array [k, n] is by how much at most each joint brings the geoms nearer
    within the boxes.
    """
    parts = np.split(boxes, [len(limbs[0].joints)], axis=2)
    (one, speeds), (other, its_speeds) = (limb.place(part[:, 0]) for limb, part in zip(limbs, parts, strict=True))
    gap = axis_gap(one, other)[1]
    length = np.linalg.norm(gap, axis=-1)
    # the geoms, convex, lie on two sides of a gap this wide across the vector between their closest points
    normal = gap / np.maximum(length, 1e-12)[:, None]
    moves = [
        limb.moves_along(normal, by_joint, part[:, 1])
        for limb, by_joint, part in zip(limbs, (speeds, its_speeds), parts, strict=True)
    ]
    return length - one.radius - other.radius, np.concatenate(moves, axis=1)


def _halved(boxes: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Return both halves of boxes [k, 2, n], each cut across one joint [k]."""
    rows, halves = np.arange(len(boxes)), np.stack([boxes, boxes])
    step = boxes[rows, 1, joint] / 2
    halves[:, rows, 1, joint] = step
    halves[:, rows, 0, joint] += np.stack([-step, step])
    return np.concatenate(halves)


def _carriers(model: mujoco.MjModel, geom: int, root: int = 0) -> list[int]:
    """Return the bodies from `root`, which is left out, to the body of the geom, which is included.

    The body nearest to `root` comes first.
    """
    bodies = [int(model.geom_bodyid[geom])]
    while bodies[-1] not in (0, root):
        bodies.append(int(model.body_parentid[bodies[-1]]))
    return bodies[-2::-1]


def joints_to(model: mujoco.MjModel, geom: int) -> int:
    """Return how many joints there are between the world and a geom."""
    return sum(int(model.body_jntnum[body]) for body in _carriers(model, geom))


def _last_common(one: list[int], other: list[int]) -> int:
    return max((body for body in one if body in other), default=0)
