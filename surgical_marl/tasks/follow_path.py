"""Path following: every arm leads its tool tip along a smooth path at constant speed, and no two arms touch.

Agents        every arm of the scene.
Observation   as in `reach`, with the reference point's place now for the goal, and the way from the tip to where the
              reference point will be 0.1, 0.2 and 0.4 s later. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step, the terms and weights of `reach`.
Success       tip within 2 mm of the reference point.
Termination   none; an episode is truncated after 250 control steps (5 s), when the path is passed once.
Randomisation cubic splines through random waypoints, half of them closed, sampled at equal arc length, from where the
              tool tip is at home. Each has its own speed, from half the greatest to the greatest, and turns by no more
              than 4 rad/s. Paths are kept only if all arms can follow them together (`tasks/base/paths.py`). Arms
              start at home.
Difficulty    greatest speed, and distance from the start: easy 10 mm/s, 50 mm; default 20 mm/s, 50 mm; hard 30 mm/s,
              70 mm. Two arms' paths come within 20 mm of each other in no episode if easy, in a tenth by default, in
              half if hard (where arms can meet at all); the arms pass there at different times.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from surgical_marl.tasks.base.path_task import PathGoal, PathTask
from surgical_marl.tasks.base.paths import loops_and_lines
from surgical_marl.tasks.base.task import FAR, Level, Views

AHEAD = (0.1, 0.2, 0.4)
"""How much later the points of the path are reached that an arm sees, s."""


class Task(PathTask):
    """Targets that pass closed and open splines."""

    draw = staticmethod(loops_and_lines)
    levels = {  # noqa: RUF012
        "easy": Level(0.05, 0.0, 0.01),
        "default": Level(0.05, 0.1, 0.02),
        "hard": Level(0.07, 0.5, 0.03),
    }

    def observations(self, views: Views, goal: PathGoal) -> dict[str, Array]:
        """[d] each; the points ahead come last."""
        known = super().observations(views, goal)
        ahead = self.along(goal.row, goal.time + np.array(AHEAD, np.float32))
        ways = {agent: (ahead[:, i] - view.tool_tip).ravel() for i, (agent, view) in enumerate(views.items())}
        return {agent: jnp.concatenate([known[agent], ways[agent]]) for agent in views}

    def bounds(self, agent: str) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest observation of an agent, [d] each."""
        low, high = super().bounds(agent)
        space = np.full(3 * len(AHEAD), 2 * FAR)
        return np.append(low, -space), np.append(high, space)
