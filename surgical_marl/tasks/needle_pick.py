"""Needle pick: an arm picks a needle up from a pad and brings its point to a goal.

SurRoL's and ORBIT-Surgical's task. Here the needle is held by contact alone.

Agents        the arm of the scene, which has a jaw with pads.
Observation   joint positions and velocities, tool tip, position targets, contact force; the needle's place, orientation
              and velocity, how the arm grips it, the way to its nearest part; the goal of its point, the way from the
              point there, if the goal has an orientation also that, and whether it was lifted. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        each step, weights in brackets. Progress over the best of the episode so far: `reach`, tool to needle (20
              / m); `grasp`, first hold (2); `lift`, over 10 mm of height (2); while it is held `carry`, point to goal
              (40 / m), and `turn`, needle to goal (2 / rad, where the goal has an orientation). `precision`, exp(-error
              / 5 mm) while held (0.1); `success` (0.2); `drop` (-2); `clearance` (-1) and `collision` (-2).
Success       the needle is held, its point within 2 mm of the goal, and, if that has an orientation, it is turned
              within 10 degrees of it.
Termination   when the needle, once lifted, is touched by no finger, or falls off the pad; an episode is truncated after
              250 control steps (5 s).
Randomisation the needle lies anywhere about the middle of the workspace, turned at random, on either side. Goals are
              where a tool can bring the needle with a grip in its middle half, 12 to 50 mm above the pad; kept only if
              the arm reaches both, off its joints' limits. The arm starts at home.
Difficulty    distance of the needle and of the goal from the middle: easy 10 mm, default and hard 25 mm; hard: the goal
              has an orientation too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from surgical_marl.cache import cached
from surgical_marl.robots.rotation import quaternion
from surgical_marl.runtime import jax
from surgical_marl.scenes.poses import Pose
from surgical_marl.tasks.base.grasp_poses import (
    bar,
    bars,
    drawn_about,
    frames,
    from_above,
    joints_at,
    leaning,
    lowest_bar,
    moved,
)
from surgical_marl.tasks.base.object_task import NEAR, ObjectGoal, ObjectTask
from surgical_marl.tasks.base.oracle_script import EARLY, Snapshot, Step, Wish
from surgical_marl.tasks.base.resting_poses import resting_poses
from surgical_marl.tasks.base.task import Start
from surgical_marl.tasks.base.workspace import choose

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene
    from surgical_marl.tasks.base.options import Options
    from surgical_marl.tasks.base.world import World

ROWS = 2048
"""Number of starts and goals."""
LOW, HIGH = 0.012, 0.05
"""Heights of goals above the pad, m."""
SAFE = 0.012
"""Least height of the whole needle above the pad at a goal, m: it is lifted there."""
ABOVE, PRESS, RAISE = 0.01, 0.0019, 0.02
"""Distances by which the oracle's tool tip stops above the wire, goes past it, and lifts it, m. A wire on a pad
is at the round ends of the fingers. They have to dent the pad, so that their flat faces hold it."""


class PickLevel(NamedTuple):
    """A level of difficulty."""

    spread: float
    """Greatest distance of the needle and of the goal from the middle of the workspace, m."""
    lean: float
    """Largest angle between the vertical and a tool that presents the needle, rad."""
    oriented: bool
    """True if the goal has an orientation."""


class Task(ObjectTask):
    """Picking a needle and presenting its point."""

    levels = {  # noqa: RUF012
        "easy": PickLevel(0.01, 0.3, False),
        "default": PickLevel(0.025, 0.3, False),
        "hard": PickLevel(0.025, 0.5, True),
    }
    default_scene = "psm_needle"
    scenes = ("psm_needle",)
    max_steps = 250
    stages = ("reached", "grasped", "lifted", "at_goal")
    wanted = {"success_rate": ("at least", 0.99), "drop_rate": ("below", 0.01)}  # noqa: RUF012

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        self._item = scene.objects[self.object].object
        about = repr((self.object, self.level, self.seed))
        table = cached("needle_pick", lambda: self._draw(scene), about, scene.fingerprint, self._item.content)
        self._set_tables(table[:, :7], frames(table[:, 7:10], table[:, 10:14]))
        self.grips = table[:, 14].astype(int)
        """Number of the bar that the oracle grips, [rows]."""

    def start(self, key: Array) -> Start:
        """Return where the needle lies, and the goal."""
        row = jax.random.randint(key, (), 0, ROWS)
        place = self.tables["starts"][row]
        return Start(ObjectGoal(row, self.nothing), poses={self.object: Pose(place[:3], place[3:])})

    def reached(self, world: World) -> dict[str, dict[str, Array]]:
        """Return which stages are reached now."""
        now = self.now(world)
        return {
            agent: {
                "reached": now.reach[agent] < NEAR,
                "grasped": now.held[agent],
                "lifted": now.held[agent] & (now.lift >= 1.0),
                "at_goal": self.at_goal(now),
            }
            for agent in world.arms
        }

    def script(self) -> tuple[Step, ...]:
        """Return how the arm does it: over the wire, down, close, up, to the goal."""
        agent, mount = self.picker, self.scene.mounts[self.picker]

        def grip(seen: Snapshot, beyond: float) -> dict[str, Wish]:
            wire = bar(seen.objects[self.object], self._item, self.grips[seen.goal.row])
            return {agent: Wish(from_above(mount, *wire, beyond), opens=True)}

        def raised(seen: Snapshot) -> dict[str, Wish]:
            return {agent: Wish(moved(seen.tools[agent], [0.0, 0.0, RAISE]))}

        def present(seen: Snapshot) -> dict[str, Wish]:
            held = np.linalg.inv(seen.objects[self.object]) @ seen.tools[agent]
            return {agent: Wish(self.goals[seen.goal.row] @ held)}

        def holds(seen: Snapshot) -> np.ndarray:
            return seen.held[agent][:, self._number]

        return (
            Step(lambda seen: grip(seen, -ABOVE)),
            Step(lambda seen: grip(seen, PRESS), wait=EARLY, pace=0.3),
            Step(lambda seen: {agent: Wish()}, wait=0.4, pace=0.3, good=holds),
            Step(raised, wait=0.1, pace=0.3, good=holds),
            Step(present, wait=0.3, pace=0.6),
        )

    def _draw(self, scene: Scene) -> np.ndarray:
        """Return starts [ROWS, 7] and goals [ROWS, 7] of the needle, and the bar that a tool grips, [ROWS, 1]."""
        mount, rng = scene.mounts[self.picker], np.random.default_rng(self.seed)
        middle = (mount.position + mount.rotation @ mount.workspace)[:2]
        middles, _ = bars(self._item)

        def batch(_: bool) -> tuple[np.ndarray, np.ndarray]:
            place = resting_poses(scene, self.object, ROWS, middle, self.level.spread, rng)
            starts, number = frames(*place), rng.integers(len(middles) // 4, -(-3 * len(middles) // 4), ROWS)
            tools = from_above(mount, *bar(starts, self._item, number), 0.0)
            q, good = joints_at(mount, tools)
            held = np.linalg.inv(tools) @ starts
            goals = leaning(rng, ROWS, self.level.lean) @ held
            points = drawn_about(rng, middle, self.level.spread, ROWS, place.position[:, 2] + [[LOW], [HIGH]])
            goals[:, :3, 3] = points - goals[:, :3, :3] @ self._item.sites[self.point][0]
            good &= joints_at(mount, goals @ np.linalg.inv(held), q)[1]
            good &= lowest_bar(goals, self._item) > starts[:, 2, 3] + SAFE
            ends = np.stack([quaternion(goal[:3, :3]) for goal in goals])
            rows = np.concatenate([*place, goals[:, :3, 3], ends, number[:, None]], -1)
            return rows[good], np.zeros(good.sum(), bool)

        return choose(scene, batch, ROWS, 0.0)
