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
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from surgical_marl.runtime import jax
from surgical_marl.tasks.base.options import Options
from surgical_marl.tasks.base.task import Goal, Level, Start, TipTask
from surgical_marl.tasks.base.workspace import start_table, target_table

if TYPE_CHECKING:
    from jax import Array

    from surgical_marl.scenes.scene import Scene


class Task(TipTask):
    """Target reaching with fixed goals."""

    levels = {"easy": Level(0.03, 0.0), "default": Level(0.05, 0.0), "hard": Level(0.07, 0.25)}  # noqa: RUF012
    starts = ("home", "random")
    wanted = {  # noqa: RUF012
        "median_error_mm": ("below", 1.0),
        "success_2mm": ("at least", 0.99),
        "collision_rate": ("below", 0.005),
    }

    def __init__(self, scene: Scene, options: Options) -> None:
        super().__init__(scene, options)
        if self.starts_at == "home":
            self.tables["targets"] = target_table(scene, self.level.extent, self.level.crossing, self.seed)
        else:
            self.tables |= start_table(scene, self.level.extent, self.seed)

    def start(self, key: Array) -> Start:
        """Return goals of all arms, and postures if these are drawn too."""
        row = jax.random.randint(key, (), 0, len(self.tables["targets"]))
        postures = self.tables.get("postures")
        return Start(Goal(self.tables["targets"][row]), None if postures is None else postures[row])
