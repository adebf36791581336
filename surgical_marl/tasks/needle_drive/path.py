"""The way of a needle through tissue along its own arc, and grips of it, on the host.

    entry = entry_poses(needle, entry, exit, pointing)       # the tip at the entry mark, the arc through both marks
    poses = driven(needle, entry, np.radians(40.0))          # turned about the arc's centre by 40 degrees

A needle is a `surgical_marl.physics.systems.needle.Needle`, which tissue with channels lists.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.tasks.base.grasp_poses import tool_poses

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from surgical_marl.physics.systems.needle import Needle


def entry_poses(needle: Needle, entry: np.ndarray, exit_: np.ndarray, pointing: np.ndarray) -> np.ndarray:
    """Return poses [n, 4, 4] of a needle whose tip is at the entry, and whose arc goes on to the exit.

    Args:
        needle: the centre line.
        entry: marks on a surface, m, [n, 3].
        exit_: likewise, nearer to the entry than the arc is wide.
        pointing: the axis about which the needle turns as it is driven, across the chord between the marks, [n, 3].
    """
    chord = exit_ - entry
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    chord = chord / length
    axis = pointing - np.sum(pointing * chord, -1, keepdims=True) * chord
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    down, half = np.cross(chord, axis), needle.bend * length / 2
    rest = np.sqrt(1 - half * half)
    along, inward = rest * chord + half * down, half * chord - rest * down
    poses = np.tile(np.eye(4), (len(entry), 1, 1))
    poses[:, :3, :3] = np.stack([along, inward, axis], -1) @ _axes(needle).T
    poses[:, :3, 3] = entry - poses[:, :3, :3] @ needle.tip
    return poses


def axis_of(needle: Needle) -> np.ndarray:
    """Return the axis about which a needle turns as it is driven, in its frame, [3]."""
    return np.cross(needle.along, needle.inward)


def centre_of(needle: Needle) -> np.ndarray:
    """Return the centre of a needle's arc, in its frame, m, [3]."""
    return np.asarray(np.array(needle.tip) + np.array(needle.inward) / needle.bend)


def driven(needle: Needle, poses: np.ndarray, angle: float | np.ndarray) -> np.ndarray:
    """Return poses [n, 4, 4] of needles that are driven on along their arcs by angles, rad, [n] or one for all."""
    return np.asarray(poses @ _turn(needle, angle))


def held_at(needle: Needle, behind: np.ndarray, lean: np.ndarray, beyond: ArrayLike) -> np.ndarray:
    """Return poses [n, 4, 4], in the needle's frame, of tools that point along the axis of its turn and grip it.

    Their x axes are towards the tip.

    Args:
        needle: the centre line.
        behind: lengths from the tip to the places that are gripped, m, [n].
        lean: angles by which tools lean outwards, about the wire, rad, [n].
        beyond: how far the tool tips are past the wire, m, [n] or one for all.
    """
    back = _turn(needle, -needle.bend * behind)
    along, inward, axis = (back[:, :3, :3] @ one for one in _axes(needle).T)
    place = back[:, :3, :3] @ needle.tip + back[:, :3, 3]
    pointing = np.cos(lean)[:, None] * axis + np.sin(lean)[:, None] * inward
    return tool_poses(place, along, pointing, np.broadcast_to(beyond, len(place)))


def reaching(needle: Needle, poses: np.ndarray, place: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles [n] by which needles are driven until their tips reach planes, rad, and the tips there [n, 3].

    Args:
        needle: the centre line.
        poses: of needles whose tips are at most on the planes, or before them, [n, 4, 4].
        place: a point of the planes, m, [3] or [n, 3].
        normal: of the planes, likewise; the side to which it points is behind the plane.
    """
    low, high = np.zeros(len(poses)), np.full(len(poses), 0.9 * np.pi)

    def tips(angle: np.ndarray) -> np.ndarray:
        there = driven(needle, poses, angle)
        return np.asarray(there[:, :3, :3] @ needle.tip + there[:, :3, 3])

    for _ in range(30):
        middle = (low + high) / 2
        before = np.sum((tips(middle) - place) * normal, -1) < 0
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    return low, tips(low)


def _axes(needle: Needle) -> np.ndarray:
    """Return the tangent at the tip, the direction to the centre and the axis of the turn, as columns, [3, 3]."""
    along, inward = np.array(needle.along), np.array(needle.inward)
    return np.stack([along, inward, axis_of(needle)], -1)


def _turn(needle: Needle, angle: float | np.ndarray) -> np.ndarray:
    """Return turns about the arc's centre by angles [n], as poses in the needle's frame, [n, 4, 4]."""
    angle, axes = np.atleast_1d(angle), _axes(needle)
    turn = np.tile(np.eye(3), (len(angle), 1, 1))
    turn[:, 0, 0] = turn[:, 1, 1] = np.cos(angle)
    turn[:, 1, 0] = np.sin(angle)
    turn[:, 0, 1] = -turn[:, 1, 0]
    turns = np.tile(np.eye(4), (len(angle), 1, 1))
    turns[:, :3, :3] = axes @ turn @ axes.T
    centre = centre_of(needle)
    turns[:, :3, 3] = centre - turns[:, :3, :3] @ centre
    return turns
