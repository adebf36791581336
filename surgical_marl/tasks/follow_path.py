"""Path following: every arm leads its tool tip along a smooth path at constant speed, and no two arms touch.

Agents        every arm of the scene.
Observation   as in `reach`, with the reference point's place now for the goal, and the way from the tip to where the
              reference point will be 0.1, 0.2 and 0.4 s later. Base frame, SI units.
Action        one number in [-1, 1] for every joint; the jaw opens above 0 and closes otherwise.
Reward        per agent, each step, the terms and weights of `reach`.
Success       tip within 2 mm of the reference point.
Termination   none; an episode is truncated after 250 control steps (5 s), when the path is passed once.
Randomisation cubic splines through random waypoints, half of them closed, sampled at equal arc length, from where the
              tool tip is at the start. Each has its own speed, from half the greatest to the greatest, and turns by no
              more than 4 rad/s. Paths are kept only if all arms can follow them together (`tasks/base/paths.py`). Arms
              start at home, or with `start=random` with joints up to a quarter of their ranges from there.
Difficulty    greatest speed, and distance from the start: easy 10 mm/s, 50 mm; default 20 mm/s, 50 mm; hard 30 mm/s,
              70 mm. Two arms' paths come within 20 mm of each other in no episode if easy, in a tenth by default, in
              half if hard (where arms can meet at all); the arms pass there at different times.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surgical_marl.tasks.base.path_task import PathTask
from surgical_marl.tasks.base.paths import loops_and_lines
from surgical_marl.tasks.base.task import Level
from surgical_marl.tasks.base.terms import Picture, Term
from surgical_marl.tasks.base.world import World

if TYPE_CHECKING:
    from jax import Array

AHEAD = (0.1, 0.2, 0.4)
"""Times of the path's points that an agent observes, s ahead of the reference point."""


class Task(PathTask):
    """Path following along closed and open splines."""

    draw = staticmethod(loops_and_lines)
    levels = {  # noqa: RUF012
        "easy": Level(0.05, 0.0, 0.01),
        "default": Level(0.05, 0.1, 0.02),
        "hard": Level(0.07, 0.5, 0.03),
    }

    def terms(self, agent: str) -> dict[str, Term | Picture]:
        """Return the terms of `reach`, and `to_path_ahead` [9], the ways from the tip to three points ahead, m."""
        terms = super().terms(agent)
        low, high = (np.tile(getattr(terms["to_target"], end), len(AHEAD)) for end in ("low", "high"))
        return {**terms, "to_path_ahead": Term(lambda w: self._ahead(w, agent), low, high, "goal")}

    def observes(self, agent: str) -> tuple[str, ...]:
        """Return the names of the terms observed in `reach`, then `to_path_ahead`."""
        return (*super().observes(agent), "to_path_ahead")

    def _ahead(self, world: World, agent: str) -> Array:
        points = self.along(world.goal.row, world.goal.time + np.array(AHEAD, np.float32))
        return (points[:, self.scene.agents.index(agent)] - world.arms[agent].tool_tip).ravel()
