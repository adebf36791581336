"""Draw marks on a wound, and how a needle begins and is held: on the host, once."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.robots.rotation import quaternion, turned
from surgical_marl.tasks.base.grasp_poses import frames, joints_at, moved, tool_of
from surgical_marl.tasks.base.resting_poses import resting_poses
from surgical_marl.tasks.base.workspace import choose
from surgical_marl.tasks.needle_drive.path import axis_of, centre_of, driven, entry_poses, held_at, reaching

if TYPE_CHECKING:
    from surgical_marl.physics.systems.needle import Needle
    from surgical_marl.scenes.scene import Scene

BITE, VARIED = 0.0065, 0.0005
"""Distance of a mark from the middle of the slit, and by how much it varies, m."""
ALONG, SKEW = 0.01, 0.001
"""Greatest distance of marks from the middle along the slit, and of one from the other, m."""
LEAN = np.radians(20.0)
"""Angle by which the axis of the needle's turn points down: a tool that pointed along the tissue would lie on it."""
BEFORE, BEYOND = np.radians(25.0), np.radians(30.0)
"""Angles of the needle's turn before the tip is at the entry, from where the oracle drives it, and past the exit."""
BACK = 0.002, 0.004
"""Least and greatest length of the needle between its tail and the middle of the jaw, m."""
PRESS = 0.0019
"""Distance by which a tool tip is past the wire that it grips, m."""
TILT = 0.1
"""Greatest angle by which a tool leans about the wire that it holds at the start, rad."""
HIGH, BESIDE, TURNED = (0.008, 0.02), 0.008, 10.0
"""The needle in the jaw begins this far above where it is driven from and this far beside it, m, and turned about each
axis by up to this, degrees."""
LOOSE = 0.004
"""Greatest distance of a needle on the pad from its place in the scene, m."""
TAIL = "tail"
"""The needle's site that a thread is tied to."""
OPEN = 0.085
"""Position of a jaw that is about to close on the wire, rad."""
SHARES = np.linspace(0.0, 1.0, 5)
"""Shares of the way at which it is looked whether the arm gets there."""


class Starts(NamedTuple):
    """Starts and marks, [n, ...] each."""

    needle: np.ndarray
    """Pose of the needle at the start, [n, 7]."""
    entry: np.ndarray
    """Pose of the needle as its tip is at the entry, [n, 7]."""
    held: np.ndarray
    """Pose of the tool in the needle's frame, [n, 7]."""
    marks: np.ndarray
    """Entry and exit in the tissue's frame at rest, m, [n, 2, 3]."""
    sweep: np.ndarray
    """Angle of the needle's turn from the entry to the exit, rad, [n]."""
    posture: np.ndarray
    """Joint positions of the arm, [n, joints]."""

    @classmethod
    def of(cls, table: np.ndarray) -> Starts:
        """Return the starts of a table of `draw_starts`."""
        needle, entry, held, marks, sweep, posture = np.split(table, np.cumsum([7, 7, 7, 6, 1]), 1)
        return cls(needle, entry, held, marks.reshape(-1, 2, 3), sweep[:, 0], posture)


class Wound(NamedTuple):
    """A wound beside an arm."""

    tissue: Any
    """The tissue (`surgical_marl.physics.systems.tissue.Tissue`)."""
    middle: np.ndarray
    """Of the slit on the upper face, in the tissue's frame, m, [3]."""
    width: float
    """Half of the slit's width, m."""
    pointing: np.ndarray
    """The axis about which a needle turns in it, in the world, [3]."""
    across: np.ndarray
    """Unit vector from the first edge to the second one, in the tissue's frame, [3]."""

    @classmethod
    def seen_from(cls, tissue: Any, place: np.ndarray, lean: float) -> Wound:
        """Return the wound in tissue whose bricks leave a slit along x, for an arm at a place [3] in the world, m.

        The arm's tool points along the slit away from there, and down by an angle `lean`, rad, so that it stays above
        the tissue.
        """
        present, size = np.array(tissue.present), np.array(tissue.size)
        gap, cell = np.argwhere(~present), size / present.shape
        low, high = gap.min(0) * cell, (gap.max(0) + 1) * cell
        middle = np.array([*(low + high)[:2] / 2, size[2]])
        axes = np.array(tissue.rotation)
        away = axes @ middle + np.array(tissue.position) - place
        along, up = axes[:, 0] * (1.0 if axes[:, 0] @ away >= 0 else -1.0), axes[:, 2]
        pointing = np.cos(lean) * along - np.sin(lean) * up
        return cls(tissue, middle, float(high[1] - low[1]) / 2, pointing, np.cross(up, along) @ axes)

    def in_world(self, rest: np.ndarray) -> np.ndarray:
        """Return places [..., 3] in the tissue's frame at rest, in the world, m."""
        return rest @ np.array(self.tissue.rotation).T + np.array(self.tissue.position)


def draw_starts(
    scene: Scene, agent: str, item: str, needle: Needle, wound: Wound, rows: int, seed: int, edges: int, picks: bool,
    beyond: float = BEYOND, back: tuple[float, float] = BACK, away: float = 1.0,
    also: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:  # fmt: skip
    """Return starts of an arm that can make the whole way of a needle, a table for `Starts.of`, [rows, k].

    Args:
        scene: the arm and the needle.
        agent: the arm.
        item: name of the needle.
        needle: its centre line.
        wound: where it is driven.
        rows: how many.
        seed: of the draws.
        edges: that it goes through: 1 for the first edge alone, up to the wall of the slit, or 2.
        picks: True if the needle lies on its pad, and the arm is at home.
        beyond: angle by which the needle is turned on past the exit, rad.
        back: least and greatest length of the needle between its tail and the middle of the jaw, m.
        away: share of the greatest distance and turn at which the needle in the jaw may begin.
        also: returns whether others can do their part, [n] bool, of poses of needles at the entry, [n, 4, 4], and the
            angles of their turns to the exit, [n].
    """
    mount, rng = scene.mounts[agent], np.random.default_rng(seed)

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        marks = _marks(wound, rows, rng)
        entry, exit_ = np.swapaxes(wound.in_world(marks), 0, 1)
        entries = entry_poses(needle, entry, exit_, np.tile(wound.pointing, (rows, 1)))
        turn = np.array(wound.tissue.rotation)
        normal = turn @ wound.across if edges == 1 else turn[:, 2]
        wall = wound.in_world(wound.middle - wound.width * wound.across if edges == 1 else wound.middle)
        sweep, tips = reaching(needle, entries, wall, normal)
        marks[:, 1] = (tips - np.array(wound.tissue.position)) @ turn
        behind = needle.length - rng.uniform(*back, rows)
        lean = np.zeros(rows) if picks else rng.uniform(-TILT, TILT, rows)
        held = held_at(needle, behind, lean, PRESS)
        tools = driven(needle, entries, sweep / 2) @ held
        turned_over = tools[:, :3, 0] @ tool_of(mount, mount.arm.home)[:3, 0] < 0  # which the roll would have to make
        held[:, :3, :2] *= np.where(turned_over, -1.0, 1.0)[:, None, None]
        starts = _lying(scene, item, needle, rows, rng) if picks else _in_jaw(needle, entries, rng, away)
        first, good = joints_at(mount, starts @ held)
        q = first
        for share in SHARES:
            angle = share * (sweep + beyond + BEFORE) - BEFORE
            q, reached = joints_at(mount, driven(needle, entries, angle) @ held, q)
            good &= reached
        good &= also(entries, sweep) if also else True
        posture = np.where(mount.arm.moves_jaw, OPEN, first)
        posture = np.tile(mount.arm.home, (rows, 1)) if picks else posture
        found = Starts(_flat(starts), _flat(entries), _flat(held), marks, sweep, posture)
        return np.concatenate([part.reshape(rows, -1) for part in found], 1)[good], np.zeros(good.sum(), bool)

    return choose(scene, batch, rows, 0.0)


def _marks(wound: Wound, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Return marks on both edges, in the tissue's frame at rest, m, [rows, 2, 3]."""
    along = np.array([1.0, 0.0, 0.0])
    middle = wound.middle + rng.uniform(-ALONG, ALONG, (rows, 1, 1)) * along
    bite = BITE + rng.uniform(-VARIED, VARIED, (rows, 2, 1))
    skew = rng.uniform(-SKEW, SKEW, (rows, 2, 1)) / 2
    return np.asarray(middle + np.array([[-1.0], [1.0]]) * bite * wound.across + skew * along)


def _in_jaw(needle: Needle, entries: np.ndarray, rng: np.random.Generator, away: float) -> np.ndarray:
    """Return poses [n, 4, 4] of the needle above the entry, or at it if `away` is 0."""
    starts = driven(needle, entries, -BEFORE)
    turns = np.array([turned(away * degrees) for degrees in rng.uniform(-TURNED, TURNED, (len(entries), 3))])
    starts[:, :3, :3] = turns @ starts[:, :3, :3]
    ways = rng.uniform([-BESIDE, -BESIDE, HIGH[0]], [BESIDE, BESIDE, HIGH[1]], (len(entries), 3))
    return moved(starts, away * ways)


def _lying(scene: Scene, item: str, needle: Needle, rows: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses [rows, 4, 4] of the needle on its pad, turned so that a tool from above points as it drives.

    A thread on its tail leaves it straight, and must not lie across its arc.
    """
    poses = frames(*resting_poses(scene, item, 6 * rows, scene.objects[item].position[:2], LOOSE, rng))
    good = (poses[:, :3, :3] @ axis_of(needle))[:, 2] < 0
    tail = scene.objects[item].object.sites[TAIL][0]
    inwards = poses[:, :3, :3] @ (centre_of(needle) - tail)
    for system in scene.systems.values():
        if any(tie.body == item for tie in system.ties):
            first, second = np.array(system.path[:2])
            good &= inwards @ (second - first) <= 0
    return poses[good][:rows]


def _flat(poses: np.ndarray) -> np.ndarray:
    """Return places and quaternions [n, 7] of poses [n, 4, 4]."""
    return np.concatenate([poses[:, :3, 3], np.stack([quaternion(pose[:3, :3]) for pose in poses])], 1)
