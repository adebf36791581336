"""Starts and goals at which two arms have to change places. The host draws them once, and environments look them up.

Each goal is a point on the axis of the other arm's shaft, as that stands at the start. So no arm can be at its goal
while the other one stays where it began. At the goals the straight lines from remote center to tool tip cross, and at
the start they don't. Straight ways in joint space collide. But if either arm draws its tool back, the other one can go,
and then the first one can follow: somebody has to go first.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.scenes.geometry import Capsule, axis_gap
from surgical_marl.scenes.scene import Mount, Scene
from surgical_marl.tasks.base.workspace import CLEARANCE, PATH_POINTS, choose, reach

ROWS = 2048
NEAREST, FARTHEST = 0.025, 0.05
"""A goal is so far from the other arm's tool tip, towards its remote center, m: beyond its wrist."""
APART = 0.005
"""Least distance between arms at their goals, m. They start `CLEARANCE` apart."""
PASS = 0.003
"""Least distance between arms that pass each other, m."""
BACK = 0.125
"""An arm that gives way draws its tool back to this share of the range of the joint that slides."""
BEYOND = 0.005
"""Lines cross where both tool tips are at least this far past the place where the lines come nearest, m."""
OTHERS = 0.03
"""Standard deviation of the goals of further arms, m."""


class Crossing(NamedTuple):
    """Rows of starts and goals, and a way there."""

    targets: np.ndarray
    """Goals [rows, arms, 3] in each arm's base frame, m."""
    ways: dict[str, np.ndarray]
    """Agent -> joint positions [4 + 1, rows, n] at the start and after each of four moves: one arm draws its tool back;
    the other goes to its goal; the first one turns, its tool drawn back; then it goes to its goal."""
    first: np.ndarray
    """Number of the arm that goes first in `ways`, [rows]: so there is more room on the way. Either arm may."""


def crossing_table(scene: Scene, spread: float, seed: int = 0) -> Crossing:
    """Return rows in which the first two arms with a jaw and a remote center have to change places.

    Args:
        spread: standard deviation of where their tool tips start, in m, the same along each axis.
        seed: of the draws; the same seed gives the same table.

    Raises:
        ValueError: the scene has no such arms, or fewer than one draw in a hundred can be kept.
    """
    pair = [agent for agent, mount in scene.mounts.items() if mount.arm.jaw and mount.arm.remote_center][:2]
    if len(pair) < 2:
        raise ValueError(
            f"difficulty 'crossing' needs a scene with two arms that have a jaw and a remote center, as PSMs; "
            f"{scene.name!r} has {len(pair)}"
        )
    settings = repr((ROWS, NEAREST, FARTHEST, APART, PASS, BACK, BEYOND, OTHERS, CLEARANCE, PATH_POINTS, spread, seed))
    table = cached("crossing", lambda: _draw(scene, pair, spread, seed), settings, scene.fingerprint)
    widths = [len(mount.arm.home) for mount in scene.mounts.values()]
    targets, begin, end, first = np.split(table, np.cumsum([3 * len(widths), sum(widths), sum(widths)]), 1)
    places, names = np.cumsum(widths)[:-1], scene.agents
    start, goal = (dict(zip(names, np.split(part, places, 1), strict=True)) for part in (begin, end))
    chosen = first[:, 0].astype(int)
    both = [_ways(scene, start, goal, goes, gives) for goes, gives in (pair, pair[::-1])]
    ways = {
        agent: np.where((chosen == scene.agents.index(pair[0]))[:, None], both[0][agent], both[1][agent])
        for agent in scene.agents
    }
    return Crossing(targets.reshape(len(table), -1, 3), ways, chosen)


def shaft(mount: Mount, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis of an arm's shaft [n, 3] in the world, and how far its tool tip is along it, m, [n].

    Args:
        mount: an arm with a remote center, which is the origin of its base frame.
        q: its joint positions, [n, joints].
    """
    axis = mount.arm.link_poses(q, (str(mount.arm.remote_center),))[str(mount.arm.remote_center)][..., :3, 2]
    tip = mount.arm.forward_kinematics(q)[..., :3, 3]
    along = np.sum(axis * tip, -1)
    axis, along = np.where(along[:, None] < 0, -axis, axis), np.abs(along)
    return axis @ mount.rotation.T, along


def _draw(scene: Scene, pair: list[str], spread: float, seed: int) -> np.ndarray:
    """Return targets, joint positions at the start and at the goals of all arms, and the arm that goes first."""
    rng = np.random.default_rng(seed)

    def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
        good, begin, end, targets = np.ones(ROWS, bool), {}, {}, {}
        for agent, mount in scene.mounts.items():
            begin[agent] = np.tile(mount.arm.home, (ROWS, 1))
            targets[agent] = mount.workspace + rng.normal(0.0, OTHERS, (ROWS, 3))
            if agent in pair:
                begin[agent], reached = reach(mount.arm, mount.workspace + rng.normal(0.0, spread, (ROWS, 3)))
                good &= reached
        for agent, other in (pair, pair[::-1]):
            axis, along = shaft(scene.mounts[other], begin[other])
            point = scene.mounts[other].position + (along - rng.uniform(NEAREST, FARTHEST, ROWS))[:, None] * axis
            targets[agent] = (point - scene.mounts[agent].position) @ scene.mounts[agent].rotation
        for agent, mount in scene.mounts.items():
            end[agent], reached = reach(mount.arm, targets[agent])
            good &= reached
        good &= (scene.clearance(begin) > CLEARANCE) & (scene.clearance(end) > APART)
        targets, begin, end = ({agent: q[good] for agent, q in part.items()} for part in (targets, begin, end))
        good = _crosses(scene, pair, end) & ~_crosses(scene, pair, begin) & (_least(scene, [begin, end]) < 0)
        for agent in pair:
            good &= scene.clearance({**begin, agent: end[agent]}) < 0
        clear = []
        for goes, gives in (pair, pair[::-1]):
            ways = _ways(scene, begin, end, goes, gives)
            clear.append(_least(scene, [{agent: way[k] for agent, way in ways.items()} for k in range(5)]))
        good &= np.min(clear, 0) > PASS
        first = np.array([scene.agents.index(agent) for agent in pair])[np.argmax(clear, 0)]
        rows = np.concatenate([*targets.values(), *begin.values(), *end.values(), first[:, None]], -1)[good]
        return rows, np.zeros(len(rows), bool)

    return choose(scene, batch, ROWS, 0.0)


def _crosses(scene: Scene, pair: list[str], q: dict[str, np.ndarray]) -> np.ndarray:
    """Return whether the straight lines of two arms from remote center to tool tip cross, [n] bool."""
    lines, lengths = [], []
    for mount, own in ((scene.mounts[agent], q[agent]) for agent in pair):
        way = mount.arm.forward_kinematics(own)[:, :3, 3] @ mount.rotation.T
        lengths.append(np.linalg.norm(way, axis=-1))
        lines.append(Capsule(mount.position + way / 2, way / lengths[-1][:, None], lengths[-1] / 2, 0.0))
    shares = axis_gap(*lines)[0], axis_gap(*lines[::-1])[0]
    return np.all([(1 - share) * length > BEYOND for share, length in zip(shares, lengths, strict=True)], 0)


def _ways(
    scene: Scene, begin: dict[str, np.ndarray], end: dict[str, np.ndarray], goes: str, gives: str
) -> dict[str, np.ndarray]:
    """Return `Crossing.ways` where one arm goes first and the other one gives way; further arms move at once."""
    ways = {agent: np.stack([begin[agent], *4 * [end[agent]]]) for agent in scene.agents}
    arm = scene.mounts[gives].arm
    slides = np.array([joint.slides for joint in arm.actuated])
    back = arm.lower + BACK * (arm.upper - arm.lower)
    withdrawn, turned = (np.where(slides, np.minimum(q[gives], back), q[gives]) for q in (begin, end))
    ways[goes] = np.stack([*2 * [begin[goes]], *3 * [end[goes]]])
    ways[gives] = np.stack([begin[gives], withdrawn, withdrawn, turned, end[gives]])
    return ways


def _least(scene: Scene, way: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Return the least distance of any two arms on straight joint-space lines from posture to posture, m, [n]."""
    least = np.full(len(next(iter(way[0].values()))), np.inf)
    for begin, end in pairwise(way):
        for share in np.linspace(0.0, 1.0, PATH_POINTS + 1):
            q = {agent: (1 - share) * begin[agent] + share * end[agent] for agent in begin}
            least = np.minimum(least, scene.clearance(q))
    return least
