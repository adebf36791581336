"""The partner's part of a stitch, on the host: it takes the needle, draws it out along its arc, pulls, hands it back.

The partner's tool comes from the other end of the slit than the driver's. Near the exit it leans outwards and dips, so
that its wrist stays above the tissue, and gets no further than a quarter of a turn; where the needle stands out of the
tissue it takes it again and leans inwards, and turns it all the way out.

    stitcher = Stitcher(scene, "psm_0", "psm_1", "needle", needle)
    stitcher.can_be_taken(entries, sweep)          # [n] bool
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.tasks.base.grasp_poses import joints_at, moved, tool_of
from surgical_marl.tasks.base.oracle_script import Snapshot, Step, Wish
from surgical_marl.tasks.needle_drive.path import axis_of, driven, held_at
from surgical_marl.tasks.needle_drive.starts import PRESS

if TYPE_CHECKING:
    from surgical_marl.physics.systems.needle import Needle
    from surgical_marl.scenes.scene import Scene


class Grip(NamedTuple):
    """Pose in which the partner's tool grips the needle."""

    lean: float
    """Angle by which it leans outwards, about the wire, rad."""
    dip: float
    """Angle by which it points away from the tip, about the axis along which its jaw closes, rad."""
    behind: float
    """Length of the needle between its tip and the place that is gripped, m."""
    beyond: float
    """Distance by which the tool tip is past the wire, m."""


FIRST = Grip(np.radians(45.0), np.radians(20.0), 0.0012, 0.0005)
"""Near the exit. Square to the wire, which stands upright there, the wrist would lie in the tissue; further past the
wire the tool tip would press on it."""
SECOND = Grip(np.radians(-45.0), 0.0, 0.0020, PRESS)
"""Where the needle stands out."""
HALFWAY, END = np.radians(70.0), np.radians(186.0)
"""Angles of the needle's turn past the exit as it is taken again, and as it is out."""
TURN = np.radians(10.0)
"""Angle by which the partner turns the needle at a time."""
APART, AWAY, CLEAR = 0.008, 0.02, 0.03
"""Distances from which a tool comes, to which it leaves, and by which it keeps above while it turns to come, m."""
WIDE = 0.4
"""Opening of a jaw that comes to the needle or leaves it, as a share of its way."""
UP = np.array([0.0, 0.2, 0.98])
"""Direction in which the thread is pulled."""
SETTLE = 0.06
"""Time before a jaw closes, s."""
PULL, NEAR = 0.015, 0.002
"""Greatest length by which it is pulled at a time, and error of the tail with which that ends, m."""


class Stitcher(NamedTuple):
    """Two arms, a needle, and where they may be."""

    scene: Scene
    driver: str
    partner: str
    item: str
    """Name of the needle."""
    needle: Needle
    beyond: float
    """Angle of the needle's turn past the exit as it is taken, rad."""

    def taken(self, poses: np.ndarray, grip: Grip) -> np.ndarray:
        """Return poses [n, 4, 4] of the partner's tool that grips needles at poses [n, 4, 4], in the world."""
        held = held_at(self.needle, np.array([grip.behind]), np.array([np.pi + grip.lean]), grip.beyond)
        cosine, sine = np.cos(grip.dip), np.sin(grip.dip)
        held[:, :3, :3] @= np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        return self._least_roll(self.partner, poses @ held)

    def _least_roll(self, agent: str, tools: np.ndarray) -> np.ndarray:
        """Return tools [n, 4, 4] turned by half a turn about their axes where the arm then rolls less."""
        mount = self.scene.mounts[agent]
        over = tools[:, :3, 0] @ tool_of(mount, mount.arm.home)[:3, 0] < 0
        tools[:, :3, :2] *= np.where(over, -1.0, 1.0)[:, None, None]
        return tools

    def can_be_taken(self, entries: np.ndarray, sweep: np.ndarray) -> np.ndarray:
        """Return whether the partner can take needles and turn them out, [n] bool.

        Args:
            entries: poses of the needles as their tips are at the entry, [n, 4, 4].
            sweep: angles of their turns from the entry to the exit, rad, [n].
        """
        mount, good = self.scene.mounts[self.partner], np.ones(len(entries), bool)
        for grip, first, last in ((FIRST, self.beyond, HALFWAY), (SECOND, HALFWAY, END)):
            there = driven(self.needle, entries, sweep + first)
            tool = self.taken(there, grip)
            q, reached = joints_at(mount, moved(tool, -APART * tool[:, :3, 2]))
            good &= reached
            for share in (0.0, 0.5, 1.0):
                poses = driven(self.needle, there, share * (last - first))
                q, reached = joints_at(mount, poses @ np.linalg.inv(there) @ tool, q)
                good &= reached
        return good

    def turned(self, poses: np.ndarray, entries: np.ndarray) -> np.ndarray:
        """Return the angles by which needles are turned from the entry on, rad, from -1 to 2 pi - 1, [n]."""
        turn, axis = (np.linalg.inv(entries) @ poses)[:, :3, :3], axis_of(self.needle)
        twice = np.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
        )
        angle = np.arctan2(twice @ axis, np.trace(turn, axis1=1, axis2=2) - 1)
        return np.where(angle < -1.0, angle + 2 * np.pi, angle)

    def script(self, task: Any, number: int) -> tuple[Step, ...]:
        """Return the steps after the drive.

        Args:
            task: the task, with its tables.
            number: of the first of these steps.
        """
        driver, partner = self.driver, self.partner
        body = list(self.scene.free_objects).index(self.item)

        def past(seen: Snapshot) -> np.ndarray:
            """Return how far needles are turned past their exits, rad, [n]."""
            row = seen.goal.row
            return self.turned(seen.objects[self.item], task.entries[row]) - task.sweep[row]

        def comes(agent: str, tool: np.ndarray, back: float, above: float) -> dict[str, Wish]:
            """Bring a tool this far back from a grip and above it; above with a roll near home, or it winds up."""
            there = moved(tool, -back * tool[:, :3, 2] + [0.0, 0.0, above])
            return {agent: Wish(there, opens=WIDE, from_home=above > 0)}

        def take(seen: Snapshot, grip: Grip, *off: float) -> dict[str, Wish]:
            return comes(partner, self.taken(seen.objects[self.item], grip), *off)

        def turn(seen: Snapshot, to: float) -> dict[str, Wish]:
            """Turn needles on about the centres of the arcs along which they were driven."""
            row, held = seen.goal.row, np.linalg.inv(seen.objects[self.item]) @ seen.tools[partner]
            angle = task.sweep[row] + np.minimum(past(seen) + TURN, to)
            return {partner: Wish(driven(self.needle, task.entries[row], angle) @ held)}

        def pull(seen: Snapshot) -> dict[str, Wish]:
            left = np.clip(self._left(task, seen), 0.0, PULL)
            return {partner: Wish(moved(seen.tools[partner], left[:, None] * UP))}

        def receive(seen: Snapshot, *off: float) -> dict[str, Wish]:
            tool = self._least_roll(driver, seen.objects[self.item] @ task.held[seen.goal.row])
            return comes(driver, tool, *off)

        def leave(seen: Snapshot, agent: str, off: bool) -> dict[str, Wish]:
            """Draw a tool back, or off the needle's tip: the first grip's tool points up as it is done, from below."""
            tool, tip = seen.tools[agent], seen.objects[self.item][:, :3, :3] @ self.needle.along
            return {agent: Wish(moved(tool, AWAY * (tip if off else -tool[:, :3, 2])), opens=WIDE)}

        def aside(seen: Snapshot) -> dict[str, Wish]:
            away = self.scene.mounts[driver].position * [1.0, 1.0, 0.0]
            away = away / np.linalg.norm(away) + [0.0, 0.0, 1.0]
            return {driver: Wish(moved(seen.tools[driver], CLEAR * away), opens=WIDE)}

        def holds(agent: str) -> Callable[[Snapshot], np.ndarray]:
            return lambda seen: seen.held[agent][:, body]

        steps: list[Step] = []

        def grips(agent: str, plan: Callable[[Snapshot, float, float], dict[str, Wish]]) -> None:
            """Add the steps in which an arm comes to the needle and grips it, again if it misses."""
            back = number + len(steps)
            steps.extend([
                Step(lambda seen: plan(seen, APART, CLEAR)),
                Step(lambda seen: plan(seen, APART, 0.0), wait=0.1, pace=0.5),
                Step(lambda seen: plan(seen, 0.0, 0.0), wait=SETTLE, pace=0.3),
                Step(lambda seen: {agent: Wish()}, wait=0.4, pace=0.3, good=holds(agent), back=back),
            ])  # fmt: skip

        def opens(agent: str, off: bool = False) -> None:
            """Add the steps in which an arm lets the needle go and leaves."""
            steps.append(Step(lambda seen: {agent: Wish(opens=WIDE)}, wait=0.3))
            steps.append(Step(lambda seen: leave(seen, agent, off), wait=0.1, pace=0.5))

        def turns(to: float) -> None:
            """Add the steps in which the partner turns the needle to an angle past the exit."""
            here = number + len(steps)
            steps.append(
                Step(lambda seen: turn(seen, to), pace=0.4, good=lambda seen: past(seen) > to - TURN / 2, back=here)
            )

        grips(partner, lambda seen, *off: take(seen, FIRST, *off))
        opens(driver)
        steps.append(Step(aside))
        turns(HALFWAY)
        opens(partner, off=True)
        grips(partner, lambda seen, *off: take(seen, SECOND, *off))
        turns(END)
        if not task.whole:
            return (*steps, Step(lambda seen: {}, wait=0.1))
        here = number + len(steps)
        steps.append(Step(pull, wait=0.1, pace=0.4, good=lambda seen: self._left(task, seen) < NEAR, back=here))
        grips(driver, receive)
        opens(partner)
        return (*steps, Step(lambda seen: {}, wait=0.1))

    def _left(self, task: Any, seen: Snapshot) -> np.ndarray:
        """Return the length of thread that is still to be pulled, m, [n]."""
        return np.asarray(seen.goal.tail) - np.asarray(task.tables["tails"])[seen.goal.row]
