"""Target reaching: every arm brings its tool tip to a target of its own, and no two arms touch.

With one arm this is the paper's target reaching, with several its multi-tool reaching.

Agents        every arm of the scene.
Observation   joint positions and velocities, tool tip, position targets, goal, goal minus tip; with other arms also the
              way from this tip to the nearest other tip, and the least distance to any other arm. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step, weights in brackets: `distance` of tip and goal (-10 / m); `precision`,
              exp(-distance / 5 mm) (1); `clearance`, up to 1 as another arm comes closer than 25 mm (-1); `collision`
              (-2). The sum over the agents is the team's: the paper's summed distance, made dense at the way's end.
Success       tip within 2 mm of the goal.
Termination   none; an episode is truncated after 100 control steps (2 s).
Randomisation goals from a normal distribution about the point in front of each arm, kept only if reachable in
              1.5 s without collision (`surgical_marl/tasks/base/workspace.py`). Arms start at home, or with
              `start=random` at postures as far from those at the goals as joints can move in 1.5 s.
Difficulty    standard deviation of the goals: easy 30 mm, default 50 mm (the paper's), hard 70 mm. Hard: in a quarter
              of the episodes of several arms the straight joint-space paths from home collide unless one arm waits.
              Crossing: two arms change places in every episode, which is truncated after 200 control steps (4 s). Each
              goal is inside the other arm's shaft as it stands at the start, so one arm has to make way first
              (`surgical_marl/tasks/base/crossing.py`).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surgical_marl.runtime import jax
from surgical_marl.tasks.base.crossing import crossing_table
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.oracle_script import Snapshot, Step, Wish
from surgical_marl.tasks.base.task import Goal, Level, Start, TipTask
from surgical_marl.tasks.base.workspace import MANY_STARTS, TABLE_SIZE, start_table, target_table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jax import Array

    from surgical_marl.scenes.scene import Scene


NEAR = 0.005
"""The oracle lets an arm follow when the other one's tip is this near to where it goes, m."""


class RowGoal(NamedTuple):
    """The goal of an episode to which a way of the joints is known."""

    targets: Array
    """Return the targets of the tool tips, [arms, 3], m, each in its arm's base frame."""
    row: Array
    """Row of the tables."""


class Task(TipTask):
    """Target reaching with fixed goals."""

    levels = {  # noqa: RUF012
        "easy": Level(0.03, 0.0),
        "default": Level(0.05, 0.0),
        "hard": Level(0.07, 0.25),
        "crossing": Level(0.02, 1.0, own_starts=True),
    }
    starts = ("home", "random")
    ways: Mapping[str, np.ndarray] | None = None
    """Joint positions on the way from the start to the targets, of each agent, [moves + 1, rows, n], if known."""
    wanted = {  # noqa: RUF012
        "median_error_mm": ("below", 1.0),
        "success_2mm": ("at least", 0.99),
        "collision_rate": ("below", 0.005),
    }

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        if self.level.own_starts:
            if self.starts_at != "home":
                raise ValueError(f"difficulty 'crossing' has starts of its own: leave start {self.starts_at!r} out")
            known = crossing_table(scene, self.level.extent, self.seed)
            self.max_steps = 200
            self._set_ways(known.ways, known.targets)
        elif self.starts_at == "home":
            self.tables["targets"] = target_table(scene, self.level.extent, self.level.crossing, self.seed)
        else:
            rows = MANY_STARTS if options.goals == "training" else TABLE_SIZE
            self._set_ways(*start_table(scene, self.level.extent, self.seed, rows))

    def _set_ways(self, ways: Mapping[str, np.ndarray], targets: np.ndarray) -> None:
        begin = {agent: way[0] for agent, way in ways.items()}
        self.ways, self.tables = ways, {"targets": targets, "postures": self.scene.full_qpos(begin)}

    def start(self, key: Array) -> Start:
        """Return goals of all arms, and postures if these are drawn too."""
        row = jax.random.randint(key, (), 0, len(self.tables["targets"]))
        postures, targets = self.tables.get("postures"), self.tables["targets"][row]
        goal = Goal(targets) if self.ways is None else RowGoal(targets, row)
        return Start(goal, None if postures is None else postures[row])

    def goal_content(self, goal: Any) -> list[np.ndarray]:
        """Return the targets, and where arms change places the row, which says also where they start."""
        return [np.asarray(goal.targets)] if self.starts_at == "random" else super().goal_content(goal)

    def script(self) -> tuple[Step, ...]:
        """Return how arms go the ways that are known, all at the same pace.

        Where they change places one draws its tool back, the other goes, then the first one follows. Where no way is
        known there is no script, and the oracle brings their tips straight to the targets.
        """
        ways = self.ways
        if ways is None:
            return ()
        last = len(next(iter(ways.values()))) - 1
        aims = {
            agent: mount.arm.forward_kinematics(ways[agent])[..., :3, 3] @ mount.rotation.T + mount.position
            for agent, mount in self.scene.mounts.items()
        }

        def move(number: int, seen: Snapshot) -> dict[str, Wish]:
            return {agent: Wish(joints=way[number, seen.goal.row]) for agent, way in ways.items()}

        def there(number: int, seen: Snapshot) -> np.ndarray:
            """Return whether the tools of all arms are about where this move or a later one ends, [n] bool.

            An arm with a policy of its own may be ahead of the script.
            """
            ends = {agent: aim[number:, seen.goal.row] for agent, aim in aims.items()}
            off = [np.linalg.norm(tool[:, :3, 3] - ends[agent], axis=-1).min(0) for agent, tool in seen.tools.items()]
            return np.asarray(np.max(off, 0) < NEAR)

        steps = [Step(partial(move, n), good=partial(there, n), back=n - 1) for n in range(1, last)]
        return (*steps, Step(partial(move, last)))
