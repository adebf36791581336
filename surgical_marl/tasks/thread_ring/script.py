"""Threading an eyelet by two arms, on the host: poses of their tools, the oracle's steps, and the reach of both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.tasks.base.grasp_poses import joints_at, moved, tool_of, tool_poses
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.base.workspace import CLEARANCE, about_home, choose
from surgical_marl.tasks.thread_ring.eyelet import Eyelet

if TYPE_CHECKING:
    from surgical_marl.scenes.scene import Scene

GRIPS = 0.018, 0.004
"""Lengths between the thread's end and where the first and the second arm take it, m. Nearer to the end, the first
arm's jaw would touch the eyelet before the second arm's has room on the other side."""
OUT = 0.012
"""Length of the thread that the first arm brings through the hole, m."""
LEAN, DEEP, BEFORE = np.radians(34.0), 0.002, 0.012
"""Angle between the vertical and the tools, as at home, and how far a tool tip goes past the thread, and how far before
it it comes in, m."""
AIM = 0.006
"""Distance from the hole at which the end is aligned with its axis, m."""
ASIDE, WAITS = 0.02, np.array([0.02, 0.0, 0.02])
"""Way that the first tool draws back, and place of the waiting second, from the hole along its axis, aside, up, m."""
NEAR = 0.001
"""Error of the length at which the oracle ends, m."""


class Threader(NamedTuple):
    """Two arms and an eyelet."""

    scene: Scene
    first: str
    second: str
    eyelet: Eyelet

    def tools(self, agent: str, places: np.ndarray, along: np.ndarray, beyond: float) -> np.ndarray:
        """Return poses [n, 4, 4] of an arm's tool that takes the thread, leaning away from the eyelet.

        Args:
            agent: the arm.
            places: on the thread, world, m, [n, 3].
            along: its direction there, [n, 3].
            beyond: how far the tool tip is past the thread, m.
        """
        mount = self.scene.mounts[agent]
        inwards = self.eyelet.axis if agent == self.first else -self.eyelet.axis
        pointing = np.sin(LEAN) * inwards - np.cos(LEAN) * np.array([0.0, 0.0, 1.0])
        # the thread lies in the plane of the jaw's plates, whichever way the tool leans in it
        across = np.cross(pointing, along)
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        x = np.cross(across, pointing)
        x = np.where((x @ tool_of(mount, mount.arm.home)[:3, 0])[:, None] < 0, -x, x)
        return tool_poses(places, x, np.broadcast_to(pointing, x.shape), np.full(len(x), beyond))

    def aimed(self, tools: np.ndarray, end: np.ndarray, along: np.ndarray, before: float) -> np.ndarray:
        """Return poses [n, 4, 4] of tools that hold a thread, moved so that its end is aligned with the hole.

        Args:
            tools: their poses, [n, 4, 4].
            end: of the thread, world, m, [n, 3].
            along: direction of the thread between tool and end, [n, 3].
            before: distance of the end from the middle of the hole, before it, m.
        """
        found = tools.copy()
        for k, turn in enumerate(_turns(along, self.eyelet.axis)):
            found[k, :3, :3] = turn @ tools[k, :3, :3]
            found[k, :3, 3] = turn @ (tools[k, :3, 3] - end[k])
        found[:, :3, 3] += self.eyelet.centre - before * self.eyelet.axis
        return found

    def waiting(self, count: int) -> np.ndarray:
        """Return poses [count, 4, 4] of the second tool as it waits behind the eyelet."""
        axis = self.eyelet.axis
        place = self.eyelet.centre + WAITS[0] * axis + WAITS[2] * np.array([0.0, 0.0, 1.0])
        return self.tools(self.second, np.tile(place, (count, 1)), np.tile(axis, (count, 1)), 0.0)

    def script(self, lengths: np.ndarray) -> tuple[Step, ...]:
        """Return the oracle's steps.

        Args:
            lengths: of the thread that should be through the hole, for each row of the task's tables, m.
        """
        first, second, axis = self.first, self.second, self.eyelet.axis

        def approach(seen: Snapshot, agent: str, beyond: float) -> Wish:
            _, two, one, behind_two, behind_one = np.moveaxis(np.asarray(seen.goal.places, float), 1, 0)
            place, behind = (one, behind_one) if agent == first else (two, behind_two)
            return Wish(self.tools(agent, place, _unit(place - behind), beyond), opens=1.0)

        def take(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            return {first: approach(seen, first, beyond), second: Wish(self.waiting(len(seen.goal.row)), opens=1.0)}

        def aim(seen: Snapshot, before: float) -> dict[str, Wish]:
            places = np.asarray(seen.goal.places, float)
            return {
                first: Wish(self.aimed(seen.tools[first], places[:, 0], _unit(places[:, 0] - places[:, 2]), before))
            }

        def pull(seen: Snapshot) -> dict[str, Wish]:
            return {second: Wish(moved(seen.tools[second], self._left(seen, lengths)[:, None] * axis))}

        def aside(seen: Snapshot) -> dict[str, Wish]:
            tool = seen.tools[first]
            return {first: Wish(moved(tool, -ASIDE * tool[:, :3, 2]), opens=1.0)}

        def holds(number: int) -> Any:
            return lambda seen: np.asarray(seen.goal.held)[:, number] > 0

        def again(seen: Snapshot) -> np.ndarray:
            return np.where(holds(0)(seen), 3, 0)

        return (
            Step(lambda seen: take(seen, -BEFORE), wait=0.1),
            Step(lambda seen: take(seen, DEEP), wait=EARLY, pace=0.4),
            Step(lambda seen: {first: Wish()}, wait=0.2, good=holds(0)),
            Step(lambda seen: aim(seen, AIM), wait=0.1, pace=0.5, good=holds(0)),
            Step(lambda seen: aim(seen, -OUT), wait=0.1, pace=0.4,
                 good=lambda seen: np.asarray(seen.goal.length) > OUT / 2, back=again),
            Step(lambda seen: {second: approach(seen, second, -BEFORE)}, wait=0.1),
            Step(lambda seen: {second: approach(seen, second, DEEP)}, wait=EARLY, pace=0.4),
            Step(lambda seen: {second: Wish()}, wait=0.2, good=holds(1), back=5),
            Step(lambda seen: {first: Wish(opens=1.0)}, wait=0.2),
            Step(aside, good=holds(1), back=0),
            Step(pull, wait=0.1, pace=0.5, good=lambda seen: np.abs(self._left(seen, lengths)) < NEAR, back=10),
            Step(lambda seen: {}, wait=0.1),
        )  # fmt: skip

    def _left(self, seen: Snapshot, lengths: np.ndarray) -> np.ndarray:
        """Return the length of thread that is still to be pulled, m, [n]."""
        return np.asarray(lengths, float)[seen.goal.row] - np.asarray(seen.goal.length, float)

    def draw(self, shift: float, turn: float, off: float, longest: float, rows: int, seed: int) -> np.ndarray:
        """Return shifts, m, and turns, rad, of the thread, and postures that the arms can do it from, [rows, 3 + nq].

        Args:
            shift: largest distance of the thread's end from where the scene places it along x and y, m.
            turn: largest angle by which it is turned about its end, rad.
            off: distance of joints from home, as in `about_home`.
            longest: greatest length to pull, m.
            rows: how many.
            seed: of the draws.
        """
        rng, scene, eyelet = np.random.default_rng(seed), self.scene, self.eyelet
        first, second = scene.mounts[self.first], scene.mounts[self.second]

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            lays = rng.uniform(-1.0, 1.0, (rows, 3)) * [shift, shift, turn]
            end, straight = eyelet.path[-1], eyelet.path[-1] - eyelet.path[0]
            angle = lays[:, 2] + np.arctan2(straight[1], straight[0])
            along = np.stack([np.cos(angle), np.sin(angle), np.zeros(rows)], -1)
            ends = end + np.pad(lays[:, :2], ((0, 0), (0, 1)))
            places = ends - GRIPS[0] * along
            held = self.tools(self.first, places, along, DEEP)
            q, good = joints_at(first, self.tools(self.first, places, along, -BEFORE))
            for pose in (held, *(self.aimed(held, ends, along, before) for before in (AIM, -OUT))):
                q, reached = joints_at(first, pose, q)
                good &= reached
            q, reached = joints_at(second, self.waiting(rows))
            taken = self.tools(
                self.second, np.tile(eyelet.centre + (OUT - GRIPS[1]) * eyelet.axis, (rows, 1)),
                np.tile(eyelet.axis, (rows, 1)), DEEP,
            )  # fmt: skip
            good &= reached
            for pose in (taken, moved(taken, (longest - OUT) * eyelet.axis)):
                q, reached = joints_at(second, pose, q)
                good &= reached
            starts = {agent: about_home(rng, mount.arm, off, rows) for agent, mount in scene.mounts.items()}
            good &= scene.clearance(starts) > CLEARANCE
            return np.concatenate([lays, scene.full_qpos(starts)], -1)[good], np.zeros(good.sum(), bool)

        return choose(scene, batch, rows, 0.0)


def _unit(ways: np.ndarray) -> np.ndarray:
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=-1, keepdims=True), 1e-9))


def _turns(ways: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return the least rotations [n, 3, 3] that turn unit vectors [n, 3] to another one [3], not its opposite."""
    v, c = np.cross(ways, to), ways @ to
    skew = np.zeros((len(ways), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    skew -= skew.transpose(0, 2, 1)
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + np.maximum(c, -0.999))[:, None, None])
